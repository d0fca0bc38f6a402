"""`python -m hippodrome.trial.interactive_gym`: the project that it makes, its remarks, and the experiments that it refuses."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from jinja2 import Environment

from hippodrome.control.config import read_project
from hippodrome.protocol.players import ONNXRUNTIME
from testing import onnx_files
from tests.trial.interactive_gym.experiments import ALONE, HELPER, PEOPLE, RUN, TOGETHER, environment, run_experiment

ROOT = Path(__file__).resolve().parents[3]


def run_python(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment(), capture_output=True, text=True, check=False
    )


def write(folder: Path, source: str = ALONE, name: str = "experiment.py") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(source + RUN)
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
    assert f"{sys.executable} -m hippodrome check {project}" in said
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
            "callbackSeconds": 10,
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


def test_a_file_beside_the_experiment_that_python_cannot_read_does_not_matter(tmp_path: Path) -> None:
    (tmp_path / "old.py").write_text('print "for Python 2"\n')
    project, _ = project_of(tmp_path, ALONE)
    assert (project / "requirements.txt").read_text().startswith("gymnasium==")
    assert (project / "old.py").is_file()


def test_a_folder_with_more_than_a_server_should_carry_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "film.bin").open("wb") as film:
        film.truncate(600 * 2**20)
    assert "holds more than 500 MB: put the experiment into a folder of its own" in refusal_of(tmp_path, ALONE)


def test_options_without_effect_get_a_remark(tmp_path: Path) -> None:
    _, said = project_of(tmp_path)
    assert "Remark: host has no effect: on one machine only its own browsers reach a study" in said
    assert "waitroom" not in said, "only what the experiment sets"


def test_a_page_between_two_episodes_takes_the_place_of_the_pause(tmp_path: Path) -> None:
    project, _ = project_of(tmp_path / "time", ALONE + "config.reset_timeout = 9000\n")
    assert config_of(project)["trial"]["betweenEpisodes"] == 9
    project, _ = project_of(tmp_path / "page", ALONE + "config.between_episode_text = 'Rest'\n")
    assert config_of(project)["trial"]["betweenEpisodes"] == "between"
    assert (project / "steps/between.html").read_text() == "<p>Rest</p>\n"


def test_players_and_their_policies_become_keys_of_the_study(tmp_path: Path) -> None:
    brains = tmp_path / "brains"
    brains.mkdir()
    (brains / "two.txt").write_text("2")
    project, _ = project_of(tmp_path, TOGETHER)
    trial = config_of(project)["trial"]
    assert trial["players"] == {"0": "human", "1": "agent:Policy1"}
    assert (trial["frameSkip"], trial["input"], trial["actionSpace"]) == (1, "single", ["0", "1", "2"])
    assert (project / "brains/two.txt").read_text() == "2"
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


def test_policies_whose_files_have_the_same_name_are_two_files(tmp_path: Path) -> None:
    for folder, inside in (("left", "1"), ("right", "2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "two.txt").write_text(inside)
    project, _ = project_of(tmp_path, THREE.replace("left/", "./left/").replace("right/", "left/../right/"))
    assert (project / "left/two.txt").read_text() + (project / "right/two.txt").read_text() == "12"
    said = refusal_of(tmp_path / "mine", THREE.replace("left/", "../left/").replace("right/", "../right/"))
    assert said == f"../left/two.txt is not below {tmp_path / 'mine'}: copy it there, or start in a folder above both"


def test_a_package_run_as_a_module_keeps_its_folders(tmp_path: Path) -> None:
    package = tmp_path / "examples" / "car"
    source = ALONE.replace("import helper", "from examples.car import helper")
    write(package, source.replace('"how.html"', '"examples/car/how.html"'), "car_server.py")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "large.bin").write_bytes(b"not ours")
    done = run_experiment(tmp_path, "examples.car.car_server")
    assert done.returncode == 0, done.stderr
    project = package / "car-server-study"
    assert (project / "examples/car/helper.py").is_file()
    assert not list(project.rglob("large.bin"))
    assert '"examples/car/car_server.py", []' in (project / "agent.py").read_text()
    assert run_python(project, "-c", "import agent; agent.Agent().start('x')").returncode == 0


def test_modules_from_a_folder_of_pythonpath_belong_to_it(tmp_path: Path) -> None:
    package = tmp_path / "examples" / "car"
    write(package, ALONE.replace("import helper", "from examples.car import helper"))
    (tmp_path / "sitecustomize.py").write_text("")  # Python imports it as it starts
    env = {**environment(), "PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
    done = subprocess.run(
        [sys.executable, "-m", "hippodrome.trial.interactive_gym", "--no-run", "experiment.py"],
        cwd=package,
        env=env,
        capture_output=True,
        text=True,
        check=False,
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
    (tmp_path / "experiment.py").write_text((ALONE + RUN).replace("Mountain car", "Another name"))
    done = run_experiment(tmp_path)
    assert done.returncode == 0, done.stderr
    assert "steps/welcome.html was changed by hand and stays; delete it to have it made again" in done.stdout
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
    (tmp_path / "experiment.py").write_text(ALONE + "server_app.run(config)\n")
    assert run_experiment(tmp_path).returncode == 0
    done = run_python(tmp_path / "experiment-study", "-c", "import agent; print(agent.Agent.__name__)")
    assert (done.returncode, done.stdout) == (0, "Agent\n"), done.stderr


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("PolicyTypes.Human}", "PolicyTypes.Random}", "policy_mapping has no PolicyTypes.Human"),
        ("PolicyTypes.Human}", 'PolicyTypes.Human, "other": "x.pkl"}', "there is no policies(policy_inference_fn=…) that could play other by 'x.pkl'"),
        ("PolicyTypes.Human}", 'PolicyTypes.Human, "other": "x.onnx"}', "the policy of other is not found: x.onnx"),
        ('"ArrowRight": RIGHT', '"ArrowRight": 7', "'ArrowRight' is the action 7; there are 0 to 2"),
        ("default_action=NOOP", "default_action=3", "default_action is the action 3; there are 0 to 2"),
        ('"MountainCar-v0"', '"MountainCarContinuous-v0"', "the environment does not say how many actions human has"),
        (".environment(env_creator=env_creator, ", ".environment(", "there is no environment: give environment(env_creator=…)"),
        ("config = (", "configs = [None]; configs[0] = (", "the experiment has 0 games"),
        ('"how.html"', '"why.html"', "instructions_html_file: there is no why.html"),
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
    assert "the environment does not say how many actions human has" in refusal_of(tmp_path, source)


def test_the_config_that_counts_is_the_one_that_the_script_runs_with_its_arguments(tmp_path: Path) -> None:
    source = (
        ALONE.replace("config = (", "def build(name):\n  return (")
        .replace("Mountain car", "{name}")
        .replace('page_title="', 'page_title=f"')
    )
    write(tmp_path)
    guarded = "import sys\nif __name__ == '__main__':\n    server_app.run(build(sys.argv[1]))\n"
    (tmp_path / "experiment.py").write_text(source + guarded)
    done = run_experiment(tmp_path, "experiment.py", "Hill")
    assert done.returncode == 0, done.stderr
    project = tmp_path / "experiment-study"
    assert config_of(project)["project"]["name"] == "Hill"
    done = run_python(project, "-c", "import agent; agent.Agent().start('x')")
    assert done.returncode == 0, done.stderr


def test_images_and_atlases_are_copied_under_their_names(tmp_path: Path) -> None:
    static = tmp_path / "server/static"
    static.mkdir(parents=True)
    (static / "cook.png").write_bytes(b"cook")
    (static / "cook.json").write_text('{"frames": {"EAST.png": {}}}')
    specs = (
        "config.rendering(assets_to_preload=["
        "object_contexts.AtlasSpec('chef', 'static/cook.png', 'static/cook.json').as_dict(),"
        "object_contexts.ImgSpec('plain.png', 'static/cook.png').as_dict(),"
        "object_contexts.ImgSpec('gone', 'static/gone.png').as_dict()])\n"
    )
    project, said = project_of(tmp_path, ALONE + specs)
    assert sorted(path.name for path in (project / "assets").iterdir()) == ["chef.json", "chef.png", "plain.png"]
    assert "Remark: the image 'gone' is not found at static/gone.png; sprites that show it are grey boxes" in said


SCENES = (
    ALONE.partition("config = (")[0]
    + """
from interactive_gym.configurations import experiment_config
from interactive_gym.scenes import gym_scene, scene, stager, static_scene
from interactive_gym.server import app

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
    .pyodide(restart_pyodide=True)
)
end = static_scene.EndScene().display(scene_header="Bye").redirect("https://example.org/?id=", append_subject_id=True)
stager = stager.Stager(scenes=[start_scene, more, GAMES, end])
if __name__ == "__main__":
    config = experiment_config.ExperimentConfig().experiment(stager=stager, experiment_id="car_study").hosting(port=0)
    app.run(config)
"""
)


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


def test_files_that_scenes_name_belong_to_the_project(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "interactive_gym/pages").mkdir(parents=True)
    (tmp_path / "interactive_gym/pages/more.html").write_text("<p>Read this file</p>")
    package = tmp_path / "interactive_gym/mine"
    source = SCENES.replace("GAMES", "game").replace("import helper", "from interactive_gym.mine import helper")
    named = 'scene_body_filepath="interactive_gym/pages/more.html"'
    write(package, source.replace('scene_body="<p>Read this</p>"', named))
    (package / "experiment.py").write_text((package / "experiment.py").read_text().replace(RUN, ""))
    done = run_experiment(tmp_path, "interactive_gym.mine.experiment")
    assert done.returncode == 0, done.stderr
    project = package / "experiment-study"
    assert (project / "steps/before_2.html").read_text() == "<p>Read this file</p>\n"
    done = run_python(project, "-c", "import agent; agent.Agent().start('x')")
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("scenes", "said"),
    [
        ("game, game", "the experiment has 2 games (GymScene), and a study has one here: make an experiment of each"),
        ("scene.SceneWrapper([game, game])", "the experiment has 2 games (GymScene), and"),
        ("more", "the experiment has 0 games (GymScene), and"),
        ("game, static_scene.OptionBoxes('id', {}, ['a'])", "the scene OptionBoxes of Interactive Gym is not here"),
        ("game, scene.RandomizeOrder([more])", "the scene RandomizeOrder of Interactive Gym is not here"),
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
    done = run_python(tmp_path, "-m", "hippodrome", "check", str(project))
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


@pytest.mark.parametrize("functions", [True, False])
def test_an_onnx_file_is_a_policy_with_interactive_gyms_functions_and_without(tmp_path: Path, functions: bool) -> None:
    onnx_files.linear(tmp_path / "brains/partner.onnx", [[1, 0, 0], [0, 1, 0]])
    source = TOGETHER.replace('"brains/two.txt"', '"brains/partner.onnx"')
    if functions:
        source = "from utils import onnx_inference_utils\n" + source.replace(
            "load_policy_fn=load", "load_policy_fn=onnx_inference_utils.load_onnx_policy_fn"
        ).replace("policy_inference_fn=infer", "policy_inference_fn=onnx_inference_utils.onnx_model_inference_fn")
    else:
        source = source.replace("load_policy_fn=load,", "").replace("policy_inference_fn=infer,", "")
    project, said = project_of(tmp_path, source)
    assert "Remark" not in said
    assert ONNXRUNTIME in (project / "requirements.txt").read_text().splitlines()
    acts = "import agent, numpy; print(agent.Policy1().act(numpy.array([100, 0]), {}))"
    done = run_python(project, "-c", acts)
    assert (done.returncode, done.stdout) == (0, "0\n"), done.stderr


def test_only_a_process_that_loads_an_experiment_knows_interactive_gyms_names(tmp_path: Path) -> None:
    project, _ = project_of(tmp_path)
    asks = "import importlib.util, sys, hippodrome.trial.server\n{}\nprint(importlib.util.find_spec('interactive_gym') is not None)"
    for first, known in (("", "False"), ("import agent", "True")):
        assert run_python(project, "-c", asks.format(first)).stdout == f"{known}\n"
