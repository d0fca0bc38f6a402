"""`python experiment.py`: the project that it makes, its remarks, and the experiments that it refuses."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from jinja2 import Environment

from hippodrome.config import read_project
from protocol.players import ONNXRUNTIME
from testing import onnx_files
from tests.trial.interactive_gym.experiments import ALONE, HELPER, PEOPLE, RUN, TOGETHER, environment, run_experiment

ROOT = Path(__file__).resolve().parents[3]
MAKE = RUN.replace("SERVE", "False")


def run_python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment(), capture_output=True, text=True, check=False
    )


def write(folder: Path, source: str = ALONE, name: str = "experiment.py") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(source + MAKE)
    (folder / "helper.py").write_text(HELPER)
    (folder / "how.html").write_text('<h1>How</h1><p><img src="key.png" alt="A key"></p>')
    (folder / "key.png").write_bytes(b"a picture")


def project_of(folder: Path, source: str = ALONE) -> tuple[Path, str]:
    write(folder, source)
    done = run_experiment(folder)
    assert done.returncode == 0, done.stderr
    return folder / "experiment-study", done.stdout


def refusal_of(folder: Path, source: str) -> str:
    write(folder, source)
    done = run_experiment(folder)
    assert done.returncode == 1
    assert not (folder / "experiment-study").exists()
    assert done.stderr.startswith("This experiment cannot be played here: "), done.stderr
    return done.stderr.removeprefix("This experiment cannot be played here: ").strip()


def config_of(project: Path) -> Any:
    return yaml.safe_load((project / "config.yml").read_text())


def test_an_experiment_becomes_a_project(tmp_path: Path) -> None:
    project, said = project_of(tmp_path)
    assert f"The project is in {project}." in said
    assert f"make -C {ROOT} check PROJECT={project}" in said, "in the experiment's folder there is no Makefile"
    found = {path.relative_to(project).as_posix() for path in project.rglob("*") if path.is_file()}
    assert found == {
        ".made-by-interactive-gym.json", "agent.py", "config.yml", "experiment.py", "helper.py", "how.html", "key.png",
        "requirements.txt", "steps/final.html", "steps/instructions.html", "steps/key.png", "steps/welcome.html",
    }  # fmt: skip
    assert config_of(project) == {
        "project": {
            "id": "Mountain-Car",
            "name": "Mountain car",
            "steps": {1: "welcome", 2: "game", "finalStep": "final"},
        },
        "trial": {
            "game": "Mountain_Car",
            "maxEpisodes": 2,
            "startingFrameRate": 60,
            "minFrameRate": 1,
            "maxFrameRate": 90,
            "actionSpace": ["left", "noop", "right"],
            "betweenEpisodes": 3,
            "idleAction": "noop",
            "keys": {"ArrowLeft": "left", "ArrowRight": "right", "a+b": "right"},
            "scene": {"width": 600, "height": 400, "background": "#FFFFFF", "coordinates": "relative"},
            "instructions": "instructions",
        },
    }
    config = read_project(project)
    assert config.trial.keys
    assert (project / "requirements.txt").read_text().startswith("gymnasium==")


def test_texts_become_pages(tmp_path: Path) -> None:
    project, _ = project_of(tmp_path)
    welcome = (project / "steps/welcome.html").read_text()
    assert "<h1>Mountain car</h1>" in welcome
    assert "{% raw %}" in welcome, "what looks like a template is shown as it is"
    instructions = (project / "steps/instructions.html").read_text()
    assert '<img src="key.png"' in instructions
    assert "<p>Go &amp; go</p>" in instructions
    final = (project / "steps/final.html").read_text()
    assert 'href="https://example.org/?a=1&amp;id={{ participant.userId|urlencode }}"' in final
    assert "5000" in final


def test_pictures_with_the_same_name_are_two_files_of_the_pages(tmp_path: Path) -> None:
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "arrow.png").write_bytes(folder.encode())
    shown = "<img src='left/arrow.png'><img src='right/arrow.png'><img src='left/arrow.png'>".replace("'", '"')
    project, _ = project_of(tmp_path, ALONE.replace('"Hello {{ you }} & <friends>"', repr(shown)))
    pictures = re.findall('src="([^"]+)"', (project / "steps/welcome.html").read_text())
    assert [(project / "steps" / name).read_text() for name in pictures] == ["left", "right", "left"]


def test_a_package_that_the_experiment_names_is_not_required_twice(tmp_path: Path) -> None:
    named = 'config.pyodide(packages_to_install=["Gymnasium[classic_control]~=1.2", "typing.extensions !=4.0"])\n'
    project, _ = project_of(tmp_path, f"import typing_extensions\n{ALONE}{named}")
    lines = (project / "requirements.txt").read_text().splitlines()
    assert lines == ["Gymnasium[classic_control]~=1.2", "typing.extensions !=4.0"]


def test_files_that_are_left_out_do_not_count_as_too_much(tmp_path: Path) -> None:
    with (tmp_path / "film.bin").open("wb") as film:
        film.truncate(600 * 2**20)
    project, said = project_of(tmp_path)
    assert "Remark: film.bin is left out: it has 600 MB, and 50 are the most" in said
    assert not (project / "film.bin").exists()


def test_options_without_effect_get_a_remark(tmp_path: Path) -> None:
    _, said = project_of(tmp_path)
    assert "Remark: host has no effect: on one machine only its own browsers reach a study" in said
    assert "Remark: max_ping has no effect: no participant is turned away" in said
    assert "waitroom" not in said, "only what the experiment sets"


def test_a_heading_and_a_time_that_a_page_ignores_get_a_remark(tmp_path: Path) -> None:
    more = "config.user_experience(game_header_text='Drive', game_page_text='<h2>On</h2>')\n"
    _, said = project_of(tmp_path / "heading", ALONE + more)
    assert "Remark: game_header_text is left out: the instructions have a heading (<h1>) of their own" in said
    project, said = project_of(
        tmp_path / "time", ALONE + "config.reset_timeout = 9000\nconfig.between_episode_text = 'Rest'\n"
    )
    assert "Remark: reset_timeout has no effect: participants go on themselves from the page between" in said
    assert config_of(project)["trial"]["betweenEpisodes"] == "between"
    project, said = project_of(tmp_path / "alone", ALONE + "config.reset_timeout = 9000\n")
    assert "reset_timeout" not in said
    assert config_of(project)["trial"]["betweenEpisodes"] == 9


def test_players_and_their_policies_become_keys_of_the_study(tmp_path: Path) -> None:
    brains = tmp_path / "brains"
    brains.mkdir()
    (brains / "two.txt").write_text("2")
    project, _ = project_of(tmp_path, TOGETHER)
    trial = config_of(project)["trial"]
    assert trial["players"] == {"0": "human", "1": "agent:Policy1"}
    assert (trial["frameSkip"], trial["input"], trial["actionSpace"]) == (1, "single", ["0", "1", "2"])
    assert (project / "policies/two.txt").read_text() == "2"
    assert "Policy1 = _experiment.policy(1)" in (project / "agent.py").read_text()
    read_project(project)


def test_what_players_do_between_two_choices_follows_interactive_gyms_server_or_its_games_in_the_browser(
    tmp_path: Path,
) -> None:
    """Its server repeats the actions of humans alone by `PreviousSubmittedAction`, its browsers those of policies."""
    before = "default_action=0, "
    previous = f"{before}action_population_method=configuration_constants.ActionSettings.PreviousSubmittedAction, "
    pyodide = "config.pyodide(run_through_pyodide=True)\n"
    for name, source, expected in (
        ("server", TOGETHER.replace(before, previous), ("single", 10_000)),
        ("browser", TOGETHER.replace(before, previous) + pyodide, ("held", None)),
        ("default", TOGETHER + pyodide, ("single", None)),
    ):
        folder = tmp_path / name
        (folder / "brains").mkdir(parents=True)
        (folder / "brains/two.txt").write_text("2")
        trial = config_of(project_of(folder, source)[0])["trial"]
        assert (trial["policyActions"], trial.get("actionBufferLifespan")) == expected, name


THREE = (
    TOGETHER.replace('1: "brains/two.txt"', '1: "left/two.txt", 2: "right/two.txt"')
    .replace("(0, 1)", "(0, 1, 2)")
    .replace("1: spaces.Discrete(3)", "1: spaces.Discrete(3), 2: spaces.Discrete(3)")
    .replace("1: {}", "1: {}, 2: {}")
)


def test_files_of_functions_with_the_same_name_are_refused_if_one_would_hide_the_other(tmp_path: Path) -> None:
    """Files below the experiment's folder keep their folders. Others are copied to `policies/`."""
    for folder, inside in (("left", "1"), ("right", "2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "two.txt").write_text(inside)
    said = refusal_of(tmp_path / "mine", THREE)
    assert said == "policy_mapping has two files that are called two.txt: give them different names"
    project, _ = project_of(tmp_path, THREE.replace("left/", "./left/").replace("right/", "left/../right/"))
    assert (project / "left/two.txt").read_text() + (project / "right/two.txt").read_text() == "12"


def test_a_package_run_as_a_module_keeps_its_folders(tmp_path: Path) -> None:
    package = tmp_path / "examples" / "car"
    write(package, ALONE.replace("import helper", "from examples.car import helper"), "car_server.py")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "large.bin").write_bytes(b"not ours")
    done = run_python(tmp_path, "-m", "examples.car.car_server")
    assert done.returncode == 0, done.stderr
    project = package / "car-server-study"
    assert (project / "examples/car/helper.py").is_file()
    assert not list(project.rglob("large.bin"))
    assert '"examples.car.car_server", "config"' in (project / "agent.py").read_text()
    assert run_python(project, "-c", "import agent; agent.Agent().start('x')").returncode == 0


def test_modules_from_a_folder_of_pythonpath_belong_to_it(tmp_path: Path) -> None:
    package = tmp_path / "examples" / "car"
    write(package, ALONE.replace("import helper", "from examples.car import helper"))
    (tmp_path / "sitecustomize.py").write_text("")  # Python imports it as it starts
    env = {**environment(), "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    done = subprocess.run(
        [sys.executable, str(package / "experiment.py")], env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    project = package / "experiment-study"
    assert (project / "examples/car/helper.py").is_file()
    assert not list(project.rglob("site-packages")), "packages are in requirements.txt"
    assert not list(project.rglob("sitecustomize.py")), "it is the machine's"
    assert run_python(project, "-c", "import agent; agent.Agent().start('x')").returncode == 0


def test_participants_read_the_words_of_an_actions_constant(tmp_path: Path) -> None:
    source = ALONE.replace("LEFT, NOOP, RIGHT = 0, 1, 2", "MoveLeft, DO_NOTHING, RIGHT = 0, 1, 2")
    source = source.replace("NOOP", "DO_NOTHING").replace("DO_DO_", "DO_").replace("LEFT", "MoveLeft")
    project, _ = project_of(tmp_path, source)
    trial = config_of(project)["trial"]
    assert trial["actionSpace"] == ["moveleft", "do_nothing", "right"]
    assert trial["labels"] == {"moveleft": "Move left"}, "no button for what has no key"
    assert read_project(project).trial.labels == {"moveleft": "Move left"}


def test_a_project_is_made_anew_and_changes_by_hand_stay(tmp_path: Path) -> None:
    project, _ = project_of(tmp_path)
    (project / "steps/welcome.html").write_text("<h1>Mine</h1>")
    (project / "data").mkdir()
    (project / "data/answer").write_text("kept")
    (tmp_path / "key.png").unlink()
    (tmp_path / "experiment.py").write_text((ALONE + MAKE).replace("Mountain car", "Another name"))
    done = run_experiment(tmp_path)
    assert done.returncode == 0, done.stderr
    assert "steps/welcome.html was changed by hand and stays; delete it to have it made anew" in done.stdout
    assert (project / "steps/welcome.html").read_text() == "<h1>Mine</h1>"
    assert config_of(project)["project"]["name"] == "Another name"
    assert not (project / "key.png").exists(), "what is no more in the experiment is removed"
    assert (project / "data/answer").read_text() == "kept"


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    mine = tmp_path / "experiment-study"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years of work")
    write(tmp_path)
    done = run_experiment(tmp_path)
    assert done.returncode == 1
    assert f"{mine} holds something else" in done.stderr
    assert [path.name for path in mine.iterdir()] == ["thesis.txt"]


def test_a_file_that_the_experiment_reads_as_it_is_imported_is_found_on_a_server(tmp_path: Path) -> None:
    project, _ = project_of(tmp_path, ALONE.replace("LEFT, NOOP", "text = open('how.html').read()\nLEFT, NOOP"))
    program = f"import sys; sys.path.insert(0, {str(project)!r}); import agent; agent._experiment"
    done = run_python(tmp_path.parent, "-c", program)
    assert done.returncode == 0, done.stderr


def test_a_run_without_a_guard_does_nothing_on_a_server(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "experiment.py").write_text(ALONE + "server_app.run(config, serve=False)\n")
    assert run_experiment(tmp_path).returncode == 0
    done = run_python(tmp_path / "experiment-study", "-c", "import agent; print(agent.Agent.__name__)")
    assert (done.returncode, done.stdout) == (0, "Agent\n"), done.stderr


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("PolicyTypes.Human}", "PolicyTypes.Random}", "policy_mapping has no PolicyTypes.Human"),
        ("PolicyTypes.Human}", 'PolicyTypes.Human, **{n: "human" for n in range(16)}}', "policy_mapping has 17 humans; at most 16 participants play together"),
        ("PolicyTypes.Human}", 'PolicyTypes.Human, "other": "x.pkl"}', "there is no policies(policy_inference_fn=…) that could play other by 'x.pkl'"),
        ('"ArrowRight": RIGHT', '"ArrowRight": 7', "'ArrowRight' leads to the action 7; there are 0 to 2"),
        ("default_action=NOOP", "default_action=3", "'default_action' leads to the action 3; there are 0 to 2"),
        ("fps=60", "fps=600", "fps must be from 1 to 240, not 600"),
        ('"MountainCar-v0"', '"MountainCarContinuous-v0"', "the actions of human must be numbered (a Discrete space); they are Box("),
        (".environment(env_creator=env_creator, ", ".environment(", "there is no environment: give environment(env_creator=…)"),
        ("import helper", "import helper, sys, types; sys.modules['eventlet'] = types.ModuleType('eventlet')", "take `import eventlet` and `eventlet.monkey_patch()` out"),
        ("config = (", "configs = [None]; configs[0] = (", "run() takes a RemoteConfig"),
    ],
)  # fmt: skip
def test_a_wrong_experiment_gets_a_sentence(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in ALONE
    source = ALONE.replace(old, new)
    if "configs" in new:
        source += "\nconfig = configs\n"
    assert said in refusal_of(tmp_path, source)


def test_an_environment_without_a_players_actions_gets_a_sentence(tmp_path: Path) -> None:
    made_by = "env_creator=env_creator"
    source = ALONE.replace(
        "config = (", "class Env(gymnasium.Env):\n    action_space = {'0': 1}\n\n\nconfig = ("
    ).replace(made_by, "env_creator=lambda **_: Env()")
    assert "the environment does not say which actions 'human' has" in refusal_of(tmp_path, source)


def test_a_config_that_is_no_variable_of_the_file_is_refused(tmp_path: Path) -> None:
    source = ALONE.replace("config = (", "def build(): return (")
    write(tmp_path, source)
    (tmp_path / "experiment.py").write_text(source + "\nserver_app.run(build(), serve=False)\n")
    done = run_experiment(tmp_path)
    assert "the config must be a variable of the experiment's file" in done.stderr


def test_images_and_atlases_are_copied_under_their_names(tmp_path: Path) -> None:
    static = tmp_path / "server/static"
    static.mkdir(parents=True)
    (static / "cook.png").write_bytes(b"cook")
    (static / "cook.json").write_text('{"frames": {"EAST.png": {}}}')
    specs = (
        "config.rendering(assets_to_preload=["
        "object_contexts.AtlasSpec('chef', 'static/cook.png', 'static/cook.json').as_dict(),"
        "object_contexts.ImgSpec('plain.png', 'static/cook.png').as_dict(),"
        "object_contexts.ImgSpec('gone', 'static/gone.png').as_dict()],"
        "animation_configs=[render_configs.Animation('walk', 'chef', ['EAST.png'], 8)])\n"
    )
    source = ALONE.replace("server_app\n", "server_app, render_configs\n") + specs
    project, said = project_of(tmp_path, source)
    assert sorted(path.name for path in (project / "assets").iterdir()) == ["chef.json", "chef.png", "plain.png"]
    assert '"walk": {"frames": ["EAST.png"], "frameRate": 8}' in (project / "assets/chef.json").read_text()
    assert "Remark: the image 'gone' is not found at static/gone.png; sprites that show it are grey boxes" in said


SCENES = (
    ALONE.partition("config = (")[0].replace("from trial import ", "from trial import experiment_config, gym_scene, stager, static_scene, ")
    + """
start_scene = static_scene.StartScene().scene(scene_id="hello").display(scene_header="Hi", scene_body="Welcome")
more = static_scene.StaticScene().display(scene_body="<p>Read this</p>")
game = (
    gym_scene.GymScene()
    .scene(scene_id="car", experiment_config={})
    .policies(policy_mapping={"human": configuration_constants.PolicyTypes.Human})
    .environment(env_creator=env_creator, env_config={"steps": 20})
    .rendering(fps=60, env_to_state_fn=draw)
    .gameplay(default_action=NOOP, action_mapping={"ArrowLeft": LEFT}, num_episodes=2, max_steps=15)
    .user_experience(scene_header="Car", scene_body="How to drive", in_game_scene_body="Drive!")
    .pyodide(restart_pyodide=False)
)
end = static_scene.EndScene().display(scene_header="Bye").redirect("https://example.org/?id=", append_subject_id=True)
stager = stager.Stager(scenes=[start_scene, more, GAMES, end])
if __name__ == "__main__":
    config = experiment_config.ExperimentConfig().experiment(stager=stager, experiment_id="car_study").hosting(port=0)
    server_app.run(config, serve=False)
"""
)  # fmt: skip


def test_scenes_before_and_after_the_game_become_pages(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "experiment.py").write_text(SCENES.replace("GAMES", "game"))
    done = run_experiment(tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Remark: restart_pyodide has no effect" in done.stdout
    project = tmp_path / "experiment-study"
    found = config_of(project)
    assert found["project"]["steps"] == {1: "hello_before_1", 2: "before_2", 3: "game", "finalStep": "after_1"}
    assert found["project"]["id"] == "car-study"
    assert (found["trial"]["maxSteps"], found["trial"]["maxEpisodes"]) == (15, 2)
    assert "How to drive" in (project / "steps/instructions.html").read_text()
    last = (project / "steps/after_1.html").read_text()
    assert 'href="https://example.org/?id={{ participant.userId|urlencode }}"' in last
    read_project(project)
    assert run_python(project, "-c", "import agent; agent.Agent().start('x')").returncode == 0


def test_texts_may_be_tuples_by_a_stray_comma_lists_paths_or_none(tmp_path: Path) -> None:
    write(tmp_path)
    texts = """
import pathlib
from trial import scene
more.display(scene_header=("Much",), scene_subheader=["more"], scene_body=("<p>Read</p>", "<p>this</p>"))
game.welcome_text, game.game_page_text, game.instructions_html_file = None, ("Go",), pathlib.Path("how.html")
stager = """
    source = SCENES.replace("GAMES", "scene.SceneWrapper(scenes=(game,))").replace("stager = ", texts, 1)
    (tmp_path / "experiment.py").write_text(source)
    done = run_experiment(tmp_path)
    assert done.returncode == 0, done.stderr
    steps = tmp_path / "experiment-study/steps"
    assert (steps / "before_2.html").read_text() == "<h1>Much</h1>\n<p>more</p>\n<p>Read</p>\n<p>this</p>\n"
    assert "Go" in (steps / "instructions.html").read_text()


@pytest.mark.parametrize(
    ("imports", "said"),
    [
        ("from trial.scenes import static_scene", "write `from trial import static_scene` and the like"),
        ("import trial.configurations.remote_config", "write `from trial import remote_config` and the like"),
        ("from trial.server import server_app", "write `from trial import server_app`"),
        ("from trial import utils", "take the import of server/utils.py out"),
        ("from trial.utils import onnx_inference_utils", "write `from trial import onnx_inference_utils`"),
        ("from trial import unity_scene", "games made with Unity are not played here"),
        ("from trial.static_scene import OptionBoxes", "its questions are written as a page of steps/"),
        ("from trial.scene import RandomizeOrder", "scenes are shown once, in the order of the stager"),
    ],
)
def test_an_import_of_interactive_gyms_that_is_not_here_says_what_to_do(imports: str, said: str) -> None:
    with pytest.raises(ImportError, match=re.escape(said)):
        exec(imports, {})


@pytest.mark.parametrize(
    ("scenes", "said"),
    [
        ("game, game", "the stager has 2 games (GymScene), and a study has one game here: make an experiment of each"),
        ("static_scene.SceneWrapper([game, game])", "the stager has 2 games (GymScene), and"),
        ("more", "the stager has no game (GymScene)"),
        ("game, type('OptionBoxes', (static_scene.StaticScene,), {})()", "a OptionBoxes is no page that can be shown"),
    ],
)
def test_wrong_scenes_are_refused(tmp_path: Path, scenes: str, said: str) -> None:
    write(tmp_path)
    (tmp_path / "experiment.py").write_text(SCENES.replace("GAMES", scenes))
    done = run_experiment(tmp_path)
    assert done.returncode == 1
    assert said in done.stderr


def test_an_experiment_with_two_humans_is_a_study_for_two_participants(tmp_path: Path) -> None:
    project, said = project_of(tmp_path, PEOPLE)
    config = config_of(project)
    assert [config["project"][key] for key in ("players", "patience", "maxServers")] == [2, 90, 3]
    assert config["trial"]["players"] == {"0": "human", "1": "human"}
    assert [config["trial"][key] for key in ("maxPing", "pingSamples")] == [250, 5]
    assert "has no effect" not in said
    assert "Remark: game_page_html_fn is called for 0 alone: all participants read the same instructions" in said
    done = run_python(tmp_path, "-m", "local.check", str(project))
    assert done.returncode == 0, done.stdout
    assert "is the game (fields) for 2 participants together" in done.stdout


def test_a_participant_without_a_partner_gets_the_address_for_that(tmp_path: Path) -> None:
    project, _ = project_of(tmp_path, PEOPLE)
    page = Environment(autoescape=True).from_string((project / "steps/final.html").read_text())
    alone, paired = (page.render(participant={"userId": "P1", "unmatched": unmatched}) for unmatched in (True, False))
    assert re.findall(r'href="([^"]+)"', alone) == ["https://example.org/alone?id=P1"]
    assert re.findall(r'href="([^"]+)"', paired) == ["https://example.org/done?id=P1"]
    assert "5000" in alone
    project, _ = project_of(
        tmp_path / "other", PEOPLE.replace("waitroom_timeout_redirect_url", "final_page_header_text")
    )
    page = Environment(autoescape=True).from_string((project / "steps/final.html").read_text())
    assert "href" not in page.render(participant={"userId": "P1", "unmatched": True}), "they have not taken part"


@pytest.mark.parametrize(("wait", "patience"), [(1, 10), (12_500, 12.5), (60_000, 60), (10**9, 3600)])
def test_a_waiting_time_is_limited_to_those_of_a_lobby(tmp_path: Path, wait: int, patience: float) -> None:
    project, _ = project_of(tmp_path, PEOPLE.replace("waitroom_timeout=90_000", f"waitroom_timeout={wait}"))
    assert config_of(project)["project"]["patience"] == patience
    read_project(project)


# ---- policies are tried


WITH_A_FILE = (
    TOGETHER.replace('"brains/two.txt"', '"brains/partner.onnx"')
    .replace("load_policy_fn=load", "load_policy_fn=onnx_inference_utils.load_onnx_policy_fn")
    .replace("policy_inference_fn=infer", "policy_inference_fn=onnx_inference_utils.onnx_model_inference_fn")
    .replace("from trial import ", "from trial import onnx_inference_utils, ")
)


def test_a_file_that_fits_is_a_policy(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "brains/partner.onnx", [[1, 0, 0], [0, 1, 0]])
    project, said = project_of(tmp_path, WITH_A_FILE)
    assert config_of(project)["trial"]["players"]["1"] == "sample:policies/partner.onnx"
    assert "Remark" not in said


def test_policies_whose_files_have_the_same_name_are_two_files(tmp_path: Path) -> None:
    for folder, weights in (("left", [[1, 0, 0], [0, 1, 0]]), ("right", [[0, 0, 1], [0, 1, 0]])):
        onnx_files.linear(tmp_path / folder / "partner.onnx", weights)
    source = WITH_A_FILE.replace('1: "brains/partner.onnx"', '1: "left/partner.onnx", 2: "right/partner.onnx"')
    source = source.replace("(0, 1)", "(0, 1, 2)").replace("1: spaces.", "2: spaces.Discrete(3), 1: spaces.", 1)
    source = source.replace("1: spaces.Box", "2: spaces.Box(0, 99, (2,)), 1: spaces.Box", 1)
    source = (
        source.replace("1: {}", "1: {}, 2: {}").replace("{0, 1}", "{0, 1, 2}").replace("1: False", "1: False, 2: False")
    )
    project, _ = project_of(tmp_path, source)
    files = [config_of(project)["trial"]["players"][player].removeprefix("sample:") for player in ("1", "2")]
    assert files == ["policies/partner.onnx", "policies/partner-2.onnx"]
    for folder, file in zip(("left", "right"), files, strict=True):
        assert (project / file).read_bytes() == (tmp_path / folder / "partner.onnx").read_bytes()


def test_a_file_that_is_no_onnx_is_refused(tmp_path: Path) -> None:
    (tmp_path / "brains").mkdir()
    (tmp_path / "brains/partner.onnx").write_bytes(b"a spreadsheet")
    assert refusal_of(tmp_path, WITH_A_FILE).startswith(
        "the policy of 1 does not fit: partner.onnx is no ONNX file that onnxruntime can read: "
    )


def test_a_file_for_other_observations_is_refused(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "brains/partner.onnx", np.ones((7, 3)))
    assert refusal_of(tmp_path, WITH_A_FILE) == (
        "the policy of 1 does not fit: partner.onnx takes observations of 7 numbers (its input 'obs'); "
        "the environment gives 2 numbers; "
        "export it for one such observation, or write a class with act() in agent.py that runs the file"
    )


def test_a_file_for_other_observations_is_refused_where_no_space_is_known(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "brains/partner.onnx", np.ones((7, 3)))
    said = refusal_of(tmp_path, WITH_A_FILE.replace("    observation_space = ", "    seen_by_all = "))
    assert "partner.onnx takes observations of 7 numbers" in said


def test_a_file_for_other_actions_is_refused(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "brains/partner.onnx", np.ones((2, 5)))
    assert refusal_of(tmp_path, WITH_A_FILE) == (
        "the policy of 1 does not fit: partner.onnx returns 5 numbers as 'output'; expected 3, one for each action"
    )


def test_without_onnxruntime_files_are_not_tried_and_the_project_names_it(tmp_path: Path) -> None:
    (tmp_path / "brains").mkdir()
    (tmp_path / "brains/partner.onnx").write_bytes(b"a spreadsheet")
    hidden = "import importlib.util, sys; sys.modules['onnxruntime'] = None\nfrom importlib import metadata\n"
    hidden += "names = metadata.packages_distributions\n"
    hidden += "metadata.packages_distributions = lambda: {k: v for k, v in names().items() if k != 'onnxruntime'}\n"
    project, said = project_of(tmp_path, hidden + WITH_A_FILE)
    assert (
        f"Remark: ONNX files are not tried, since onnxruntime is not installed here: pip install {ONNXRUNTIME}" in said
    )
    assert ONNXRUNTIME in (project / "requirements.txt").read_text().splitlines()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("return int(policy)", "return [1, 2][int(policy)]", "the policy of 1 fails: IndexError: list index out of range (experiment.py:"),
        ("return int(policy)", "return 3", "the policy of 1 chose action 3; there are 0 to 2"),
        ("return open(name)", "return open(name + '.gz')", "the policy of 1 fails: FileNotFoundError: "),
    ],
)  # fmt: skip
def test_functions_that_choose_no_action_are_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    (tmp_path / "brains").mkdir()
    (tmp_path / "brains/two.txt").write_text("2")
    assert old in TOGETHER
    assert refusal_of(tmp_path, TOGETHER.replace(old, new)).startswith(said)
