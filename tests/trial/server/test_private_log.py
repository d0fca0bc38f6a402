"""No line of a trial server's log names a participant, even if the error that is logged does."""

import io
import logging

from hippodrome.trial.agent.tracebacks import IdFilter


def test_the_traceback_of_an_error_is_logged_without_participants_ids():
    out, logger = io.StringIO(), logging.Logger("of this test")
    logger.addFilter(IdFilter(lambda: ["R_4hJkLz"]))
    logger.addHandler(logging.StreamHandler(out))
    try:
        raise KeyError("R_4hJkLz")
    except KeyError:
        logger.exception("the game of %s failed", "R_4hJkLz")
    assert "the game of (participant) failed\nTraceback" in out.getvalue()
    assert "KeyError: '(participant)'" in out.getvalue()
    assert "R_4hJkLz" not in out.getvalue()
