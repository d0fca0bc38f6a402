"""`hippodrome data` on a folder: runs that repeat, are interrupted, or find damaged files or broken input."""

from __future__ import annotations

import gzip
import importlib.util
import json
import os
import shutil
import signal
import threading
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pyarrow.parquet as pq
import pytest

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from hippodrome.control.model import warm_pool
from hippodrome.control.model.project import MASTER_LIST, MasterList
from hippodrome.control.model.records import to_json
from hippodrome.export import fetch, manifest, recording
from hippodrome.export import run as export_run
from hippodrome.export.fetch import Fetcher, interruption
from hippodrome.export.page_fields import fields_of
from hippodrome.export.records import Record, Records
from hippodrome.export.source import FileGone, Folder
from hippodrome.export.table_files import TableFile
from hippodrome.export.tables import Episodes
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import handover_key
from testing.studies import study
from tests.export import data_world as made_of
from tests.export.data_world import GAME, PROJECT, answer, arrive, crowd, key, record, recording_key, server
from tests.export.place import Place, rows

# What there is


def test_a_study_becomes_tables_recordings_and_a_manifest(place: Place) -> None:
    users = crowd(place.put, place.tmp, 4)
    told = place.done()
    assert told["counts"] == {
        "participants": 4, "answers": 14, "recordings": 3, "episodes": 3, "frames": 15, "foreign": 0, "finished": 3,
        "problems": 0,
    }  # fmt: skip
    found = place.rows()
    assert [row["participant"] for row in found] == users
    assert [row["finished"] for row in found] == ["true", "true", "true", "false"]
    first = found[0]
    assert (first["group"], first["2.age"], first["2.pet"], first["3.score"]) == ("1", "20", "cat; dog", "12.5")
    assert first["link.PROLIFIC_PID"] == f"prolific-of-{users[0]}"
    assert first["header.user-agent"] == "Firefox on a phone"
    assert first["answered.2"] == made_of.TIME
    table = pq.read_table(place.out / "answers.parquet")
    assert table.column_names == list(first)
    assert table["2.pet"].to_pylist()[0] == ["cat", "dog"]
    assert table["3.score"].to_pylist() == [12.5, 12.5, 12.5, None]
    episodes = place.rows("episodes")
    assert [row["participant"] for row in episodes] == users[:3]
    joined = {"participant", "studyStep", "attempt", "trial", "episode"}
    assert joined <= set(episodes[0]) & set(pq.read_schema(place.out / episodes[0]["file"]).names)
    assert (episodes[0]["studyStep"], "step" in episodes[0]) == ("3", False), "a recording's step is another thing"
    assert (episodes[0]["frames"], episodes[0]["score"], episodes[0]["seed"]) == ("5", "7.5", "41")
    assert pq.read_metadata(place.out / episodes[0]["file"]).num_rows == 7
    on_disk = {p.relative_to(place.out).as_posix() for p in place.out.rglob("*") if p.is_file()}
    assert set(place.listed()) == {n for n in on_disk if not n.startswith("private/")} - {"manifest.json"}
    assert not [name for name in on_disk if name.endswith(".part")]


def test_answers_from_an_earlier_page_of_a_step_are_marked(place: Place) -> None:
    users = crowd(place.put, place.tmp, 3)
    assert place.done()["moved"] == []  # the versions of a page for groups are one page
    assert not [column for column in place.rows()[0] if column.startswith("page.")]
    for user, page in zip(users, ("about", "consent", "questionnaire"), strict=True):
        place.put(key(user, "answers/2.json"), json.dumps(answer("2", {"age": "20"}, page=page)).encode())
    assert place.done()["moved"] == [{"step": "2", "page": "questionnaire", "others": {"about": 1, "consent": 1}}]
    assert [row["page.2"] for row in place.rows()] == ["about", "consent", "questionnaire"]
    assert list(place.rows()[0]).index("page.2") < list(place.rows()[0]).index("answered.1")
    told = place.run().err
    assert "Step 2 is questionnaire now, and has 1 answer from about: column page.2 says which." in told
    assert "`finished` is by the steps as they are now." in told


def test_each_step_whose_page_has_versions_has_a_column_with_the_version(place: Place) -> None:
    """Two versions of consent and three of the survey are crossed: one column `group` cannot hold both."""
    for registered in (True, False):
        if registered:
            steps = [
                msgspec.structs.replace(step, variants={"1": 2, "4": 3}.get(step.key, 0)) for step in PROJECT.steps
            ]
            place.put(MASTER_LIST, to_json(MasterList([study(steps=steps)])))
        else:
            (place.data / MASTER_LIST).unlink()
        for user, consent, survey in (("user-1", 1, 0), ("user-2", 0, 2)):
            arrive(place.put, user, {"2": {"age": "20"}}, group=survey)
            for step, page, group in (("1", "consent", consent), ("4", "survey", survey)):
                given = answer(step, {"x": "1"}, page=f"{page}-{group}", group=group)
                place.put(key(user, f"answers/{step}.json"), json.dumps(given).encode())
        place.done()
        columns = ("group", "group.1", "group.4")
        assert [[row[column] for column in columns] for row in place.rows()] == [["0", "1", "0"], ["2", "0", "2"]]
        assert "group.2" not in place.rows()[0]


PAGE = """
<input name="age" type="number"> <input type="range" name="mood" value="{{ answers["1"].mood }}">
<input name="zip"> <input name="one" type="checkbox"> <INPUT type="CHECKBOX" name="pet" value="cat">
<input name=pet type=checkbox value=dog> <select multiple name="days"><option>Mon</select> <select name="hand"></select>
<input name="both" type="number"><textarea name="both"></textarea>
"""


def test_a_page_says_which_of_its_fields_send_numbers_and_which_lists() -> None:
    kinds = fields_of(PAGE)
    assert {name for name in kinds if kinds[name] == "number"} == {"age", "mood"}
    assert {name for name in kinds if kinds[name] == "list"} == {"pet", "days"}
    assert {name for name in kinds if kinds[name] == "text"} == {"zip", "one", "hand", "both"}
    assert fields_of(f"<![1]>{PAGE}<![") == kinds, "whatever else stands there"


def test_columns_have_the_order_of_the_fields_on_the_page(place: Place) -> None:
    made_of.register(place.put)
    place.put("maze/steps/questionnaire.html", PAGE.encode())
    arrive(place.put, "user-1", {"2": {"old": "1", "zip": "1", "mood": "2"}})
    arrive(place.put, "user-2", {"2": {"made": "1", "pet": "cat", "age": "3"}})
    place.done()
    columns = [name.partition(".")[2] for name in place.rows()[0] if name.startswith("2.")]
    assert columns == ["age", "mood", "zip", "pet", "old", "made"], "what the page does not have comes last"


def test_a_column_has_the_type_of_its_field_on_the_page(place: Place) -> None:
    made_of.register(place.put)

    def types(**sent: str | list[str]) -> dict[str, str]:
        arrive(place.put, f"user-{len(place.rows()) if place.out.exists() else 0}", {"2": sent})
        assert place.done()["counts"]["problems"] == 0
        schema = pq.read_schema(place.out / "answers.parquet")
        return {name: str(schema.field(f"2.{name}").type) for name in ("age", "mood", "zip", "pet") if name in sent}

    first: dict[str, str | list[str]] = {"age": "31", "mood": "2.50", "zip": "90210", "pet": "cat"}
    assert types(**first) == {"age": "int64", "mood": "string", "zip": "int64", "pet": "string"}  # there are no pages
    place.put("maze/steps/questionnaire.html", PAGE.encode())
    lists = "list<element: string>"
    assert types(**first) == {"age": "int64", "mood": "double", "zip": "int64", "pet": lists}
    assert pq.read_table(place.out / "answers.parquet")["2.pet"].to_pylist() == [["cat"], ["cat"]]
    assert types(**first | {"age": "07", "mood": "1e3"}) == {
        "age": "int64",
        "mood": "double",
        "zip": "int64",
        "pet": lists,
    }
    assert types(**first | {"age": "1.50", "zip": "007"}) == {
        "age": "double",
        "mood": "double",
        "zip": "string",
        "pet": lists,
    }
    ages = pq.read_table(place.out / "answers.parquet")["2.age"].to_pylist()
    assert ages == [31.0, 31.0, 7.0, 1.5]
    assert [row["2.age"] for row in place.rows()] == ["31", "31", "07", "1.50"], "CSV has them as they were sent"
    assert types(**first | {"age": "about 30"})["age"] == "string"  # no field for numbers has sent that
    assert types(**first | {"age": "9" * 20})["age"] == "string"


def test_values_recorded_by_callbacks_are_a_table(place: Place) -> None:
    (user,) = crowd(place.put, place.tmp, 1, callbacks=[
        {"callback": "on_tick", "name": "lean", "value": {"left": 0.5}},
        {"callback": "on_tick", "name": "said", "value": 'text, "quoted"'},
        {"callback": "on_tick", "name": "on_tick", "error": "ValueError: no such thing"},
        {"callback": "on_tick", "name": "on_tick", "skipped": 7},
    ])  # fmt: skip
    assert place.done()["counts"]["problems"] == 0, "what comes after an episode's end does not cut it off"
    found = place.rows("callbacks")
    (path,) = {row.pop("file") for row in found}
    assert (place.out / path).is_file()
    assert found[0] == {
        "participant": user, "studyStep": "3", "attempt": "1", "trial": "t-1", "episode": "1", "step": "5",
        "time": "2026-11-21T14:46:40.000009Z", "callback": "on_tick", "name": "lean", "value": '{"left":0.5}',
        "error": "", "skipped": "",
    }  # fmt: skip
    assert [(row["name"], row["value"], row["error"], row["skipped"]) for row in found[1:]] == [
        ("said", 'text, "quoted"', "", ""),
        ("on_tick", "", "ValueError: no such thing", ""),
        ("on_tick", "", "", "7"),
    ]
    assert pq.read_table(place.out / "callbacks.parquet")["skipped"].to_pylist() == [None, None, None, 7]


def test_without_callbacks_there_is_no_table_of_them(place: Place) -> None:
    crowd(place.put, place.tmp, 1)
    place.done()
    assert not list(place.out.glob("callbacks.*"))


def test_only_the_owner_may_read_downloaded_files(place: Place) -> None:
    before = os.umask(0o022)
    try:
        crowd(place.put, place.tmp, 2)
        place.done("--raw", "--format", "csv,parquet,minari")
        assert os.umask(0o022) == 0o022, "only while it writes"
    finally:
        os.umask(before)
    made = [place.out, *place.out.rglob("*")]
    assert len(made) > 15
    assert [path.name for path in made if path.stat().st_mode & 0o077] == []
    place.out.chmod(0o755)
    assert "Other users of this machine can read" in place.run().err


def test_documents_of_warm_servers_count_as_no_participants(place: Place) -> None:
    users = crowd(place.put, place.tmp, 2)
    name = "s" + "a" * 20 + "-1"
    handover = Handover(users[0], 1, made_of.server(users[0]))
    place.put(handover_key("maze", name), handover.to_json())
    waiting = warm_pool.Pool().with_new(made_of.PROJECT, 2, datetime.now(UTC))
    place.put(warm_pool.pool_key("maze"), to_json(waiting))
    assert place.done()["counts"]["participants"] == 2
    assert place.done()["counts"]["foreign"] == 0
    (played,) = place.rows("episodes")
    assert (played["participant"], played["attempt"]) == (users[0], "1")
    assert not [p for p in place.out.rglob("*") if p.is_file() and name.encode() in p.read_bytes()]


def test_csv_alone_fetches_no_recordings_and_the_run_says_so(place: Place) -> None:
    crowd(place.put, place.tmp, 3)
    assert place.done("--format", "csv")["run"]["new"] == 3 * 3 + 2 * 2  # without the two recordings
    assert not (place.out / "recordings").exists()
    assert not (place.out / "answers.parquet").exists()
    ran = place.run("--format", "csv")
    assert "Recordings were not fetched" in ran.err
    assert "episodes  " not in ran.out + ran.err
    assert place.done("--format", "csv,parquet")["run"]["new"] == 2
    assert (place.out / "answers.parquet").exists()
    assert "Recordings were not fetched" not in place.run().err


@pytest.mark.parametrize("formats", ["csv", "parquet", "minari"])
def test_another_format_removes_nothing_and_leaves_nothing_out_of_date(place: Place, formats: str) -> None:
    users = crowd(place.put, place.tmp, 3)
    place.done("--format", "csv,parquet,minari", "--long")
    before = set(place.listed())
    record_of_one = key(users[0], "")
    shutil.rmtree(place.data / record_of_one)
    place.done("--format", formats)
    assert set(place.listed()) == {path for path in before if users[0] not in path}
    assert users[0] not in pq.read_table(place.out / "answers.parquet")["participant"].to_pylist()
    for name in ("answers", "answers-long", "episodes"):
        assert place.rows(name)
        assert users[0] not in {row["participant"] for row in place.rows(name)}
    hdf5 = (place.out / "minari/maze-3-v0/data/main_data.hdf5").read_bytes()
    assert users[0].encode() not in hdf5
    assert users[1].encode() in hdf5


def test_a_format_whose_package_is_gone_is_removed_as_it_would_be_out_of_date(place: Place, monkeypatch: Any) -> None:
    crowd(place.put, place.tmp, 1)
    place.done("--format", "csv,parquet")
    monkeypatch.setattr(export_run, "find_spec", lambda name: None)
    place.done("--format", "csv")
    assert not (place.out / "answers.parquet").exists()


def test_raw_files_are_copied_byte_by_byte(place: Place) -> None:
    (user, *_) = crowd(place.put, place.tmp, 2)
    place.done()
    assert place.done("--raw")["run"]["changed"] == place_files(place)
    raw = place.out / "private" / "raw" / user
    for rest in ("participant.json", "answers/2.json", f"trials/{server(user)}/3-episode-0001.jsonl.gz"):
        assert (raw / rest).read_bytes() == (place.data / key(user, rest)).read_bytes()
    assert place.done("--raw")["run"]["changed"] == 0
    (raw / "answers/2.json").write_text("{}")
    assert place.run("--check").code == Exit.FAILED
    assert place.done("--raw")["run"]["damaged"] == 1


def place_files(place: Place) -> int:
    return sum(1 for path in (place.data / "maze" / "users").rglob("*") if path.is_file())


def test_long_has_a_row_for_each_text(place: Place) -> None:
    crowd(place.put, place.tmp, 1)
    place.done("--long")
    pets = [row["value"] for row in place.rows("answers-long") if row["field"] == "pet"]
    assert pets == ["cat", "dog"]
    assert place.rows("answers-long")[0]["page"] == "consent-1"


def test_answers_of_a_study_that_is_no_longer_registered_are_exported(place: Place) -> None:
    crowd(place.put, place.tmp, 3)
    (place.data / "project_master_list.json").write_text('{"projects": [{"id": 7}]}')
    ran = place.run()
    assert ran.code == Exit.DONE
    assert "cannot be read" in ran.err
    assert [row["finished"] for row in place.rows()] == ["", "", ""]
    assert [name for name in place.rows()[0] if name.startswith("answered")] == [f"answered.{n}" for n in (1, 2, 3, 4)]


# Again


def test_a_second_run_fetches_only_what_is_new_or_changed(place: Place) -> None:
    users = crowd(place.put, place.tmp, 4)
    place.done()
    before = place.listed()
    assert place.done()["run"] | {"unchanged": 0} == {
        "participants": 4, "new": 0, "changed": 0, "unchanged": 0, "gone": 0, "bytes": 0, "damaged": 0
    }  # fmt: skip
    assert place.listed() == before  # the same input gives the same bytes
    place.put(recording_key(users[3]), record(place.tmp, users[3]))
    arrive(place.put, "user-late", {"1": {"consent": "no"}})
    place.put(key(users[0], "answers/2.json"), json.dumps(made_of.answer("2", {"age": "99"})).encode())
    told = place.done()
    assert (told["run"]["new"], told["run"]["changed"]) == (3, 1)
    assert place.rows()[0]["2.age"] == "99"
    assert len(place.rows()) == 5
    assert len(place.rows("episodes")) == 4


@pytest.mark.parametrize("more", [(), ("--dry-run",)])
def test_a_project_that_the_folder_does_not_hold_is_refused_and_those_that_it_holds_are_named(
    place: Place, more: tuple[str, ...]
) -> None:
    place.put(MASTER_LIST, to_json(MasterList([PROJECT])))
    crowd(place.put, place.tmp, 1)
    ran = place.run(*more, study="mase")
    assert (ran.code, f"There is no project mase in the folder {place.data}" in ran.err) == (Exit.FAILED, True)
    assert "It holds: maze." in ran.err
    assert f"--from {place.data}" in place.run("--from", str(place.tmp), *more).err
    assert not place.out.exists()


def test_a_dry_run_says_what_there_is_to_do_and_makes_nothing(place: Place) -> None:
    crowd(place.put, place.tmp, 3)
    size = sum(path.stat().st_size for path in (place.data / "maze").rglob("*") if path.is_file())
    dry = place.run("--dry-run", "--json")
    assert (dry.code, dry.json["new"], dry.json["participants"], dry.json["bytes"]) == (Exit.CHANGES, 15, 3, size)
    assert not place.out.exists()
    place.done()
    assert place.run("--dry-run").code == Exit.DONE
    before = everything(place.out / "private")
    (place.out / "recordings/user-0000/1/3-episode-0001.parquet").unlink()
    shutil.rmtree(place.data / key("user-0001", ""))
    dry = place.run("--dry-run", "--json")
    assert (dry.json["damaged"], dry.json["changed"], dry.json["gone"]) == (1, 1, 6)
    assert everything(place.out / "private") == before


def test_a_dry_run_gives_no_participant_a_number(place: Place) -> None:
    crowd(place.put, place.tmp, 2)
    assert place.run("--dry-run", "--identities", "apart").code == Exit.CHANGES
    assert not place.out.exists()
    place.done("--identities", "apart")
    before = everything(place.out)
    arrive(place.put, "user-new", {"1": {"consent": "yes"}})
    assert place.run("--dry-run", "--json", "--identities", "apart").json["new"] == 2
    assert everything(place.out) == before


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_participants_erased_at_the_source_are_erased_in_the_folder(place: Place) -> None:
    users = crowd(place.put, place.tmp, 4)
    place.done("--raw", "--format", "csv,parquet,minari", "--identities", "apart", "--long")
    numbers = {row["userId"]: row["participant"] for row in rows(place.out / "private/identities.csv")}
    shutil.rmtree(place.data / key(users[1], ""))
    assert place.done("--identities", "apart")["run"]["gone"] == 6
    left = "".join(path.name + str(path.parent) for path in place.out.rglob("*"))
    assert numbers[users[1]] not in left
    assert users[1] not in left
    assert len(place.rows()) == 3
    for path in place.out.rglob("*"):
        if path.is_file():
            body = path.read_bytes()
            assert users[1].encode() not in body, path
            assert numbers[users[1]].encode() not in body, path


def test_an_empty_source_empties_no_folder(place: Place) -> None:
    crowd(place.put, place.tmp, 2)
    place.done()
    before = place.listed()
    shutil.rmtree(place.data / "maze" / "users")
    ran = place.run()
    assert ran.code == Exit.FAILED
    assert "this folder holds theirs" in ran.err
    assert place.listed() == before
    assert place.run("--check").code == Exit.DONE


@pytest.mark.parametrize("how", ["missing", "shorter", "same size"])
def test_a_damaged_file_is_found_by_its_hash_and_made_again(place: Place, how: str) -> None:
    crowd(place.put, place.tmp, 3)
    place.done()
    before = place.listed()
    victim = place.out / "recordings/user-0001/1/3-episode-0001.parquet"
    body, times = victim.read_bytes(), victim.stat()
    if how == "missing":
        victim.unlink()
    else:
        victim.write_bytes(body[:-5] if how == "shorter" else bytes([*body[:100], body[100] ^ 1, *body[101:]]))
        os.utime(victim, ns=(times.st_atime_ns, times.st_mtime_ns))
    (place.out / "recordings" / "stray.txt").write_text("somebody's")
    checked = place.run("--check", "--json")
    assert checked.code == Exit.FAILED
    assert [line.split(" ")[0] for line in checked.json["wrong"]] == ["recordings/user-0001/1/3-episode-0001.parquet"]
    assert checked.json["foreign"] == ["recordings/stray.txt"]
    (place.out / "recordings" / "stray.txt").unlink()
    told = place.done()
    assert (told["run"]["damaged"], told["run"]["changed"]) == (1, 1)
    assert place.listed() == before


def test_a_file_of_somebody_else_in_the_folder_is_named_and_is_no_damage(place: Place) -> None:
    crowd(place.put, place.tmp, 2)
    place.done()
    (place.out / "note.txt").write_text("somebody's")
    checked = place.run("--check")
    assert checked.code == Exit.DONE
    assert "Not in the manifest: note.txt." in checked.err
    assert "they may be moved away" in " ".join(checked.err.split())


def test_a_damaged_manifest_is_reported_and_written_again(place: Place) -> None:
    crowd(place.put, place.tmp, 2)
    place.done()
    for name in ("manifest.json", "private/manifest.json"):
        (place.out / name).write_text('{"files": [')
        checked = place.run("--check")
        assert (checked.code, f"{name} is damaged" in checked.err) == (Exit.FAILED, True)
        place.done()
    assert place.run("--check", out=place.tmp / "nowhere").code == Exit.FAILED


@pytest.mark.parametrize("damage", [b"", b'{"files": 5}', b'{"user": "user-0001", "number": "", "files": [{}]}', None])
def test_a_participant_whose_record_is_damaged_or_gone_is_fetched_again(place: Place, damage: bytes | None) -> None:
    crowd(place.put, place.tmp, 3)
    place.done()
    before, kept = place.listed(), place.out / "private/records/user-0001.json"
    if damage is None:
        kept.unlink()
    else:
        kept.write_bytes(damage)
    assert place.done()["run"]["new"] == 6
    assert place.listed() == before


def test_recordings_are_converted_one_at_a_time_by_one_thread(place: Place, monkeypatch: Any) -> None:
    """Memory does not grow with the number of recordings: ten threads would each keep what a long one takes."""
    convert, threads = recording.convert, set()

    def noted(*args: Any, **named: Any) -> Any:
        threads.add(threading.get_ident())
        return convert(*args, **named)

    monkeypatch.setattr(recording, "convert", noted)
    crowd(place.put, place.tmp, 12)
    assert place.done()["counts"]["recordings"] == 11
    assert len(threads) == 1


# Cut off


class Trouble(Exception):
    pass


@pytest.mark.parametrize("error", [KeyboardInterrupt, Trouble])
@pytest.mark.parametrize("at", [0, 1, 7, 20])
def test_a_run_interrupted_while_fetching_is_continued(place: Place, monkeypatch: Any, at: int, error: Any) -> None:
    crowd(place.put, place.tmp, 8)
    other = place.tmp / "whole"
    assert place.run(out=other).code == Exit.DONE
    calls = iter(range(1000))
    read, fetched = Folder.read, Folder.fetch

    def cut(self: Folder, *args: Any) -> Any:
        if args[0] != "project_master_list.json" and next(calls) == at:
            raise error
        return (read if isinstance(args[0], str) else fetched)(self, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Folder, "read", cut)
        patch.setattr(Folder, "fetch", cut)
        patch.setattr(fetch, "MAX_WAITING", 2)
        patch.setattr(fetch, "PARALLEL", 1)
        code = main(["data", "maze", "--to", str(place.out), "--from", str(place.data)])
    assert code == (Exit.INTERRUPTED if error is KeyboardInterrupt else Exit.FAILED)
    assert not (place.out / "manifest.json").exists()
    told = place.done()
    if at == 20:
        assert 0 < told["run"]["new"] < place_files(place)  # what was done is not done again
    assert place.listed() == {
        line["path"]: line["sha256"] for line in json.loads((other / "manifest.json").read_text())["files"]
    }


def test_ctrl_c_ends_a_run_where_it_can_be_ended_and_at_once_if_pressed_again() -> None:
    def press() -> None:  # not by a signal, which a collection of garbage might swallow
        handler = signal.getsignal(signal.SIGINT)
        assert callable(handler)
        handler(signal.SIGINT, None)

    def pressed_at_the_end() -> None:
        with interruption() as check:
            check()
            press()
            for end in (check, press):
                with pytest.raises(KeyboardInterrupt):
                    end()

    with pytest.raises(KeyboardInterrupt):
        pressed_at_the_end()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_file_that_was_not_noted_before_a_kill_is_made_again(place: Place) -> None:
    """The file exists, but the state does not name it, so it is made again."""
    crowd(place.put, place.tmp, 3)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Records, "save", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert place.run().code == Exit.INTERRUPTED
    left = place.out / "private" / "incoming" / "half.part"
    left.write_bytes(b"half a file")
    assert place.done()["run"]["new"] == place_files(place)
    assert not left.exists()


ERASED = "user-0001"


def killed_while_a_record_is_written(place: Place) -> None:
    replace = os.replace

    def kill(part: Path, target: Path) -> None:
        if target.name == f"{ERASED}.json":
            raise KeyboardInterrupt
        replace(part, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", kill)
        assert place.run("--raw").code == Exit.INTERRUPTED
    assert (place.out / f"private/records/{ERASED}.part").exists()


def killed_before_a_record_names_the_recording(place: Place) -> None:
    save = Records.save

    def kill(self: Records, of: Record) -> None:
        if of.user == ERASED and of.recordings():
            raise KeyboardInterrupt
        save(self, of)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Records, "save", kill)
        assert place.run("--raw").code == Exit.INTERRUPTED
    assert any((place.out / "recordings" / ERASED).rglob("*.parquet"))


def damaged_record(place: Place) -> None:
    place.done("--raw")
    (place.out / f"private/records/{ERASED}.json").write_text("{")


def killed_while_datasets_are_made(place: Place) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "rename", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert place.run("--format", "minari").code == Exit.INTERRUPTED
    assert (place.out / "private/minari.part").exists()


def folder_of_an_earlier_version(place: Place) -> None:
    """It kept answers in a database, and had no records."""
    place.done("--raw")
    shutil.rmtree(place.out / "private/records")
    (place.out / "private/about.json").unlink()
    for name in ("state.sqlite", "state.sqlite-wal"):
        (place.out / "private" / name).write_text(ERASED)


LEFTOVERS = [
    killed_while_a_record_is_written,
    killed_before_a_record_names_the_recording,
    damaged_record,
    killed_while_datasets_are_made,
    folder_of_an_earlier_version,
]


@pytest.mark.parametrize("leave", LEFTOVERS)
def test_nothing_of_an_erased_participant_is_left_by_an_earlier_run(place: Place, leave: Any) -> None:
    crowd(place.put, place.tmp, 3)
    leave(place)
    notes = [place.out / "notes" / "day.txt", place.out / "private" / "key.txt", place.out / "recordings.txt"]
    for note in notes:
        note.parent.mkdir(exist_ok=True)
        note.write_text("the researcher's")
    before = everything(place.out)
    shutil.rmtree(place.data / key(ERASED, ""))
    place.run("--dry-run")
    place.run("--check")
    assert everything(place.out) == before
    assert place.run("--raw").code == Exit.DONE
    assert not [path for path in place.out.rglob("*") if ERASED in str(path.relative_to(place.out))]
    assert not [name for name, body in everything(place.out).items() if ERASED.encode() in body]
    assert all(note.exists() for note in notes)
    assert len(place.rows("episodes")) == 1
    for note in notes:
        note.unlink()
    assert place.run("--check").code == Exit.DONE


@pytest.mark.parametrize("leave", LEFTOVERS)
def test_leftovers_are_kept_if_the_source_has_no_participants(place: Place, leave: Any) -> None:
    crowd(place.put, place.tmp, 3)
    leave(place)
    (place.data / "maze" / "users").rename(place.tmp / "elsewhere")
    before = set(everything(place.out))
    assert place.run().code == Exit.FAILED
    assert before <= set(everything(place.out))


def test_a_run_without_recordings_keeps_those_that_are_here(place: Place) -> None:
    crowd(place.put, place.tmp, 3)
    place.done("--raw", "--format", "parquet")
    (place.out / "answers.parquet").unlink()
    here = {name for name in everything(place.out) if name.startswith(("recordings/", "private/raw/"))}
    assert place.run("--format", "csv").code == Exit.DONE
    assert here
    assert here <= set(everything(place.out))


@pytest.mark.parametrize("what", [(TableFile, "_write"), (Episodes, "rows"), (manifest, "write")])
def test_tables_are_whole_after_an_interruption(place: Place, what: tuple[Any, str]) -> None:
    users = crowd(place.put, place.tmp, 3)
    place.done()
    before = {name: (place.out / name).read_bytes() for name in ("answers.csv", "answers.parquet", "manifest.json")}
    arrive(place.put, users[2], {"3": GAME})
    with pytest.MonkeyPatch.context() as patch:

        def stop(*args: Any, **named: Any) -> Any:
            raise KeyboardInterrupt

        patch.setattr(*what, stop)
        assert place.run().code == Exit.INTERRUPTED
    if what[0] is not manifest:  # a table is replaced whole or not at all
        assert {name: (place.out / name).read_bytes() for name in before} == before
    place.done()
    assert place.rows()[2]["3.score"] == "12.5"


def test_a_second_run_in_the_same_folder_is_refused(place: Place) -> None:
    from hippodrome.export import run

    crowd(place.put, place.tmp, 2)
    place.done()
    with run._locked(place.out):
        ran = place.run()
    assert (ran.code, "Another run" in ran.err) == (Exit.FAILED, True)


@pytest.mark.parametrize(
    ("error", "cause", "advice"),
    [
        (OSError(28, "No space left on device"), "No space left", "Make room"),
        (OSError(13, "Permission denied", "out/answers.csv"), "Permission denied", "out/answers.csv"),
        (OSError(30, "Read-only file system"), "Read-only file system", "write"),
        (OSError("cannot open the file"), "cannot open the file", "HIPPODROME_DEBUG=1"),
        (FileNotFoundError(2, "No such file or directory", "x.hdf5"), "x.hdf5", "HIPPODROME_DEBUG=1"),
    ],
)
def test_errors_of_the_file_system_are_reported_in_a_sentence(
    place: Place, error: OSError, cause: str, advice: str
) -> None:
    crowd(place.put, place.tmp, 2)

    def refuse(*_: Any) -> Any:
        raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Fetcher, "_move", refuse)
        ran = place.run()
    assert (ran.code, cause in ran.err, advice in ran.err) == (Exit.FAILED, True, True), ran.err
    assert ("Make room" in ran.err) == (error.errno == 28)
    place.done()


# Broken input


def test_broken_input_is_listed(place: Place) -> None:
    users = crowd(place.put, place.tmp, 3)
    whole = record(place.tmp, users[0], frames=2000)
    put = place.put
    put(recording_key(users[0], "3-episode-0002"), whole[: len(whole) // 2])
    put(recording_key(users[0], "3-episode-0003"), b"")
    put(recording_key(users[0], "3-episode-0004"), b"not gzip at all")
    put(recording_key(users[0], "3-episode-0005"), gzip.compress(b'{"kind":"step","episode":1}\n[1]\n{"kind":'))
    put(recording_key(users[0], "3-episode-0006"), whole[:3000] + b"\0" * 50 + whole[3050:])
    put(key(users[1], "answers/1.json"), b"{")
    put(key(users[1], "answers/2.json"), b'["a list"]')
    put(key(users[1], "answers/7.json"), json.dumps(made_of.answer("9", "no object", group="x", answered=5)).encode())
    put(key(users[2], "participant.json"), json.dumps({"arrived": "yesterday", "group": 1.5, "link": []}).encode())
    for foreign in ("notes.txt", "answers/../1.json", "trials/x.gz", "answers/link.json", "trials/a/b/c.jsonl.gz"):
        put(f"maze/users/{users[2]}/{foreign}" if ".." not in foreign else key(users[2], "answers/.1.json"), b"?")
    put(key(users[2], "trials/a/3-episode-0001.jsonl.gz.part"), b"?")
    put("maze/users/not an id/participant.json", b"{}")
    put("maze/users/file.txt", b"?")
    (place.data / "maze/users" / users[2] / "answers" / "5.json").symlink_to("/etc/hostname")
    told = place.done("--format", "csv,parquet,minari")
    problems: dict[str, list[str]] = {}
    for row in place.rows("problems"):
        problems.setdefault(row["file"], []).append(row["problem"])
    assert told["counts"]["problems"] == sum(map(len, problems.values()))
    trial = f"{users[0]}/trials/{server(users[0])}"
    assert problems[f"{trial}/3-episode-0002.jsonl.gz"][-1] == "the last line is cut off and was left out"
    assert "the file is empty" in problems[f"{trial}/3-episode-0003.jsonl.gz"]
    assert "the file is damaged" in problems[f"{trial}/3-episode-0004.jsonl.gz"][0]
    assert "a line that is no JSON object was left out" in problems[f"{trial}/3-episode-0005.jsonl.gz"]
    assert "the file is damaged" in problems[f"{trial}/3-episode-0006.jsonl.gz"][0]
    assert problems[f"{users[1]}/answers/1.json"] == ["it is no JSON"]
    assert problems[f"{users[1]}/answers/2.json"] == ["it is no JSON object"]
    assert len(problems[f"{users[1]}/answers/7.json"]) == 4
    assert len(problems[f"{users[2]}/participant.json"]) == 3
    foreign = [name for name, why in problems.items() if why[0].startswith("no file of Hippodrome")]
    assert len(foreign) == 9
    half = pq.read_table(place.out / "recordings" / users[0] / "1" / "3-episode-0002.parquet")
    assert 100 < half.num_rows < 2000
    assert half["step"].to_pylist()[2:50] == list(range(2, 50))
    assert "hostname" not in str(place.listed())
    assert place.done()["counts"]["problems"] == told["counts"]["problems"]  # also of files that were not fetched again


def test_a_file_deleted_while_it_is_fetched_is_skipped(place: Place, monkeypatch: Any) -> None:
    users = crowd(place.put, place.tmp, 3)
    with pytest.MonkeyPatch.context() as patch:
        read = Folder.read

        def vanish(self: Folder, at: str, most: int) -> bytes:
            if users[0] in at:
                raise FileGone(at)
            return read(self, at, most)

        patch.setattr(Folder, "read", vanish)
        place.done()
    assert place.rows()[0]["1.consent"] == ""
    place.done()
    assert place.rows()[0]["1.consent"] == "yes"


def test_folders_of_participants_are_distinct_on_every_machine(place: Place) -> None:
    users = ["Ann", "ann", "ANN", "x"]
    for user in users:
        place.put(recording_key(user), record(place.tmp, user))
    place.done()
    before = {row["participant"]: row["file"] for row in place.rows("episodes")}
    assert before.keys() == set(users)
    assert len({path.lower() for path in before.values()}) == len(users)
    arrive(place.put, "AnN", {})  # comes before others in the source
    assert place.done()["run"]["changed"] == 0
    assert {row["participant"]: row["file"] for row in place.rows("episodes")} == before


def test_foreign_folders_and_wrong_options_are_refused(place: Place, tmp_path: Path) -> None:
    crowd(place.put, place.tmp, 2)
    full = tmp_path / "full"
    full.mkdir()
    (full / "thesis.txt").write_text("mine")
    assert place.run(out=full).code == Exit.FAILED
    assert [path.name for path in full.iterdir()] == ["thesis.txt"]
    assert place.run(out=full / "thesis.txt").code == Exit.FAILED
    for own in ("manifest.json", "private/letter.txt", "recordings/song.txt"):
        (full / own).parent.mkdir(exist_ok=True)
        (full / own).write_text('{"name": "mine"}')
    before = everything(full)
    assert "has other files already" in place.run(out=full).err
    assert everything(full) == before
    for wrong in (["--format", "xls"], ["--format", ","], ["--identities", "away"]):
        assert place.run(*wrong).code == Exit.FAILED
    assert place.run(study="another").code == Exit.FAILED
    assert place.run(study="no such/id").code == Exit.FAILED
    place.done()
    assert "identities together" in place.run("--identities", "apart").err
    (place.out / "private/about.json").unlink()  # as an earlier version leaves it
    assert "identities together" in place.run("--identities", "apart").err
    assert main(["data", "maze", "--to", str(place.out), "--from", str(tmp_path / "none")]) == Exit.FAILED


def test_formulas_are_escaped_too_if_datasets_are_the_only_format(place: Place) -> None:
    arrive(place.put, "ann", {"2": {"pet": "=1+1"}})
    place.done("--format", "minari", "--spreadsheet")
    assert place.rows()[0]["2.pet"] == "'=1+1"


@pytest.mark.parametrize(("formats", "package"), [("parquet", "pyarrow"), ("csv,minari", "minari")])
def test_a_package_that_is_missing_is_named_before_anything_is_done(
    place: Place, monkeypatch: Any, formats: str, package: str
) -> None:
    crowd(place.put, place.tmp, 1)
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == package else there(name))
    ran = place.run("--format", formats)
    assert (ran.code, f"The package {package} is not installed" in ran.err) == (Exit.FAILED, True)
    assert 'pip install "hippodrome[data]"' in ran.err
    assert not place.out.exists()
    assert place.run("--format", "csv").code == Exit.DONE


def test_another_missing_package_is_no_traceback(place: Place, monkeypatch: Any) -> None:
    crowd(place.put, place.tmp, 1)

    def without(*_: Any) -> Any:
        raise ModuleNotFoundError("No module named 'msgspec'", name="msgspec")

    monkeypatch.setattr(Folder, "list", without)
    ran = place.run()
    assert (ran.code, "`hippodrome data` needs the package msgspec, which is not installed." in ran.err) == (
        Exit.FAILED,
        True,
    )
