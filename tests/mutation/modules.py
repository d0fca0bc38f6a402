"""What is mutated, and the quick tests that judge it: the pure core, and services on the platform in memory."""

from __future__ import annotations

SERVICES = ("servers", "spares", "spares_races", "limits", "naming", "sweep", "relays", "causes", "metrics")
TESTED_BY: dict[str, tuple[str, ...]] = {
    "hippodrome/causes.py": ("causes", "servers", "metrics"),
    "hippodrome/ending.py": SERVICES,
    "hippodrome/forms.py": ("forms", "journey"),
    "hippodrome/fragments.py": ("fragments", "pages"),
    "hippodrome/giving.py": ("spares", "spares_races", "limits"),
    "hippodrome/http.py": ("http", "forms", "journey"),
    "hippodrome/ids.py": ("ids", "journey", "participant", "messages"),
    "hippodrome/journey.py": ("journey", "journey_files", "repeated_forms", "previews", "limits"),
    "hippodrome/limits.py": ("limit_rules", "limits", "spares"),
    "hippodrome/messages.py": ("messages", "relays"),
    "hippodrome/naming.py": ("naming", *SERVICES),
    "hippodrome/pages.py": ("pages", "journey"),
    "hippodrome/participant.py": ("participant", "repeated_forms", "journey"),
    "hippodrome/places.py": ("limits", "spares", "journey"),
    "hippodrome/pool.py": ("spares", "sweep_garbage", "spares_races", "limits"),
    "hippodrome/previews.py": ("previews",),
    "hippodrome/project.py": ("project", "journey", "registry", "participant", "servers", "spares", "limits", "pages"),
    "hippodrome/server.py": ("server_record", *SERVICES),
    "hippodrome/spares.py": ("spare_rules", "spares", "spares_races"),
    "hippodrome/starting.py": ("task_requests", *SERVICES),
    "hippodrome/sweep.py": ("sweep", "sweep_garbage", *SERVICES),
    "hippodrome/waiting.py": ("waiting", "journey"),
    "protocol/trial.py": ("config_trial", "config", "config_registration"),
    "protocol/values.py": ("config_trial", "config", "config_registration"),
    "trial/controls.py": ("trial/test_trial_wire", "trial/test_trial_core"),
    "trial/frames.py": ("trial/test_trial_wire", "trial/test_trial_frames"),
    "trial/game.py": ("trial/test_trial_game", "trial/test_trial_core"),
    "trial/messages.py": ("trial/test_trial_wire", "trial/test_trial_core"),
    "trial/past.py": ("trial/test_trial_past",),
    "trial/recording.py": ("trial/test_trial_disk", "trial/test_trial_past", "trial/test_trial_core"),
    "trial/watchdog.py": ("trial/test_trial_wire", "trial/test_trial_core"),
}


def concerned(module: str) -> list[str]:
    """The files of tests, the nearest first."""
    names = dict.fromkeys(TESTED_BY[module])
    return [f"tests/{name}.py" if "/" in name else f"tests/test_{name}.py" for name in names]
