"""Policies, the players that are no humans. The files are real ONNX files, run by onnxruntime."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
import types
from collections import Counter
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiDiscrete, Tuple
from onnx import TensorProto, helper, save

from hippodrome.protocol.players import ONNXRUNTIME
from hippodrome.trial.core.players import policy_seed
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.policies.places import PolicyThread, load
from hippodrome.trial.policies.policy import PolicyError
from testing import onnx_files
from testing.waiting import PATIENCE, until_async

TWO = Box(-1, 1, (2,), np.float32)
ROOT = Path(__file__).resolve().parents[3]


def agent_module(**classes: type) -> types.ModuleType:
    made = types.ModuleType("agent")
    vars(made).update(classes)
    return made


def load_policy(spec: str, folder: Path, count: int = 3, space: Any = TWO, **more: Any) -> Any:
    return load(spec, folder, None, count, space, **more)


def refusal(spec: str, folder: Path, count: int = 3, space: Any = TWO) -> str:
    with pytest.raises(PolicyError) as refused:
        load_policy(spec, folder, count, space)
    return str(refused.value)


# ---- policies without a file


def test_random_takes_every_legal_action_and_no_other(tmp_path: Path) -> None:
    policy = load_policy("random", tmp_path, 4)
    policy.reset(1)
    taken = Counter(policy.act(None, {}, (True, False, True, True)) for _ in range(900))
    assert sorted(taken) == [0, 2, 3]
    assert min(taken.values()) > 200


def test_random_repeats_itself_after_the_same_seed(tmp_path: Path) -> None:
    policy, runs = load_policy("random", tmp_path, 50), []
    for seed in (7, 7, 8):
        policy.reset(seed)
        runs.append([policy.act(None, {}, None) for _ in range(20)])
    assert runs[0] == runs[1] != runs[2]


def test_idle_takes_the_idle_action_unless_it_is_forbidden(tmp_path: Path) -> None:
    policy = load_policy("idle", tmp_path, 3, idle=2)
    assert policy.act(None, {}, None) == 2
    assert policy.act(None, {}, (False, True, False)) == 1


def test_a_class_of_agent_py_plays(tmp_path: Path) -> None:
    class Partner:
        def __init__(self, player: str) -> None:
            self.player = player

        def act(self, observation: Any, info: Any) -> Any:
            return np.int64(observation + info["more"])

        def reset(self, seed: int) -> None:
            self.seed = seed

    policy = load("agent:Partner", tmp_path, agent_module(Partner=Partner), 5, player="player_3")
    policy.reset(12)
    assert policy.act(1, {"more": 3}, None) == 4
    assert policy.description() == {"kind": "policy", "policy": "agent:Partner"}
    assert (policy._instance.player, policy._instance.seed) == ("player_3", 12)


def test_a_class_of_agent_py_may_take_the_mask_and_need_nothing_else(tmp_path: Path) -> None:
    class Partner:
        def __init__(self, depth: int = 2) -> None:
            assert depth == 2

        def act(self, _observation: Any, _info: Any, mask: Any) -> int:
            return list(mask).index(True)

    policy = load("agent:Partner", tmp_path, agent_module(Partner=Partner), 3)
    policy.reset(1)
    policy.close()
    assert policy.act(None, {}, (False, True, True)) == 1


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (3, "act() returned action 3; there are 0 to 2"),
        (-1, "act() returned action -1; there are 0 to 2"),
        (1, "act() returned action 1, which action_mask forbids now"),
        (0.5, "act() returned '0.5', which is no action; return its number"),
        (float("nan"), "act() returned 'nan', which is no action; return its number"),
        (None, "act() returned 'None', which is no action; return its number"),
        (True, "act() returned 'True', which is no action; return its number"),
    ],
)
def test_a_class_that_returns_no_legal_action_is_refused(tmp_path: Path, action: Any, said: str) -> None:
    class Partner:
        def act(self, _observation: Any, _info: Any) -> Any:
            return action

    policy = load("agent:Partner", tmp_path, agent_module(Partner=Partner), 3)
    with pytest.raises(PolicyError, match="act") as refused:
        policy.act(None, {}, (True, False, True))
    assert str(refused.value) == said


def test_the_error_about_a_missing_class_names_those_that_there_are(tmp_path: Path) -> None:
    class Helper:
        def act(self) -> None: ...

    class Other: ...

    class Few:
        def act(self, observation: Any) -> int: ...

    agent = agent_module(Helper=Helper, Other=Other, Few=Few)
    for spec, where, said in (
        ("agent:Partner", agent, "there is no class Partner in agent.py; classes with act() there: Helper, Few"),
        ("agent:Other", agent, "class Other in agent.py has no act(observation, info)"),
        ("agent:Few", agent, "act of class Few in agent.py takes other values; write act(self, observation, info)"),
        ("agent:Partner", None, "agent:Partner is a class of agent.py, and there is no agent.py"),
    ):
        with pytest.raises(PolicyError) as refused:
            load(spec, tmp_path, where, 3)
        assert str(refused.value) == said


def test_an_entry_that_is_no_player_is_refused(tmp_path: Path) -> None:
    assert refusal("robot", tmp_path).startswith("'robot' is no player; write human, random, idle, agent:Class")


# ---- files


WEIGHTS = [[1, 0, -1], [0, 2, 0]]


def test_a_file_takes_the_action_with_the_highest_value(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "policies/p.onnx", WEIGHTS)
    policy = load_policy("policies/p.onnx", tmp_path)
    assert [policy.act(seen, {}, None) for seen in ([1, 0], [0, 1], [-1, 0], (2, 1.5))] == [0, 1, 2, 1]


def test_a_mask_leaves_the_best_of_the_legal_actions(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "p.onnx", WEIGHTS)
    assert load_policy("p.onnx", tmp_path).act([0, 1], {}, (True, False, True)) == 0


def test_sample_draws_by_the_softmax_and_repeats_itself_after_the_same_seed(tmp_path: Path) -> None:
    onnx_files.constant(tmp_path / "p.onnx", np.log(np.array([[0.7, 0.2, 0.1]], np.float32)))
    policy, runs = load_policy("sample:p.onnx", tmp_path), []
    for seed in (3, 3, 4):
        policy.reset(seed)
        runs.append([policy.act([0, 0], {}, None) for _ in range(2_000)])
    assert runs[0] == runs[1] != runs[2]
    shares = [runs[0].count(action) / 2_000 for action in range(3)]
    assert shares == pytest.approx([0.7, 0.2, 0.1], abs=0.05)


def test_the_description_names_the_file_and_its_hash(tmp_path: Path) -> None:
    file = onnx_files.linear(tmp_path / "p.onnx", WEIGHTS)
    import hashlib

    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    assert load_policy("p.onnx", tmp_path).description() == {"kind": "policy", "policy": "p.onnx", "sha256": sha256}


@pytest.mark.parametrize(
    ("space", "seen", "action"),
    [
        (Dict({"b": Box(0, 9, (1,)), "a": Discrete(9)}), {"b": [3.0], "a": 1}, 1),
        (Tuple([Box(0, 9, (1,)), Box(0, 9, (1,))]), ([3.0], [1.0]), 0),
        (Discrete(2), 1, 1),
        (Discrete(3, start=-1), None, None),
        (Box(0, 9, (2, 1)), [[1], [3]], 1),
        (Dict({"observation": TWO, "action_mask": Box(0, 1, (3,))}), {"observation": [1, 3], "action_mask": [1, 1, 1]}, 1),
    ],
    ids=["a map by sorted keys", "a tuple", "one-hot", "one-hot of another size", "an array", "beside a mask"],
)  # fmt: skip
def test_observations_become_the_numbers_that_the_file_takes(
    tmp_path: Path, space: Any, seen: Any, action: Any
) -> None:
    onnx_files.linear(tmp_path / "p.onnx", WEIGHTS)
    if seen is None:
        assert "the environment gives one number" in refusal("p.onnx", tmp_path, space=space)
    else:
        assert load_policy("p.onnx", tmp_path, space=space).act(seen, {}, None) == action


def test_images_may_have_their_channels_first(tmp_path: Path) -> None:
    weights = np.zeros((2 * 3 * 4, 2), np.float32)
    weights[0, 0] = weights[12, 1] = 1  # of channel 0 and of channel 1, at the same place
    onnx_files.linear(tmp_path / "p.onnx", weights, shape=("batch", 2, 3, 4))
    policy = load_policy("p.onnx", tmp_path, 2, Box(0, 255, (3, 4, 2), np.uint8))
    picture = np.zeros((3, 4, 2), np.uint8)
    picture[0, 0, 1] = 5
    assert policy.act(picture, {}, None) == 1


def test_parts_of_an_observation_go_to_the_inputs_of_their_names(tmp_path: Path) -> None:
    nodes = [helper.make_node("Concat", ["left", "right"], ["output"], axis=1)]
    onnx_files.save(tmp_path / "p.onnx", nodes, [("left", (1, 1)), ("right", (1, 2))], [("output", (1, 3))])
    policy = load_policy("p.onnx", tmp_path, 3, Dict(right=Box(0, 9, (2,)), left=Box(0, 9, (1,))))
    assert policy.act({"left": [1], "right": [0, 4]}, {}, None) == 2


MAP = Dict(right=Box(0, 9, (2,)), left=Box(0, 9, (1,)), direction=Discrete(3, start=1))


def test_a_file_need_not_take_all_parts_of_an_observation(tmp_path: Path) -> None:
    nodes = [helper.make_node("Identity", ["right"], ["output"])]
    onnx_files.save(tmp_path / "p.onnx", nodes, [("right", (1, 2))], [("output", (1, 2))])
    policy = load_policy("p.onnx", tmp_path, 2, MAP)
    assert policy.act({"left": [1], "right": [0, 4], "direction": 1}, {}, None) == 1


@pytest.mark.parametrize("wide", [True, False])
def test_a_discrete_part_becomes_one_hot_if_its_input_takes_that(tmp_path: Path, wide: bool) -> None:
    nodes = [helper.make_node("Concat", ["right", "direction"], ["output"], axis=1)]
    size = 3 if wide else 1
    inputs = [("right", (1, 2)), ("direction", (1, size))]
    onnx_files.save(tmp_path / "p.onnx", nodes, inputs, [("output", (1, 2 + size))])
    policy = load_policy("p.onnx", tmp_path, 2 + size, MAP)
    seen = {"left": [9], "right": [0, 0], "direction": 3}
    assert policy.act(seen, {}, None) == (4 if wide else 2)


def test_an_output_that_is_not_used_may_be_of_any_type(tmp_path: Path) -> None:
    """As scikit-learn's classifiers are exported: the label, and a list of maps with the probabilities."""
    nodes = [
        helper.make_node("ArgMax", ["x"], ["output_label"], axis=1, keepdims=0),
        helper.make_node("ZipMap", ["x"], ["output_probability"], domain="ai.onnx.ml", classlabels_int64s=[0, 1]),
    ]
    maps = helper.make_sequence_type_proto(
        helper.make_map_type_proto(TensorProto.INT64, helper.make_tensor_type_proto(TensorProto.FLOAT, []))
    )
    outputs = [
        helper.make_tensor_value_info("output_label", TensorProto.INT64, [1]),
        helper.make_value_info("output_probability", maps),
    ]
    graph = helper.make_graph(nodes, "g", [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 2])], outputs)
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("ai.onnx.ml", 3)]
    save(helper.make_model(graph, opset_imports=opsets, ir_version=9), tmp_path / "p.onnx")
    assert load_policy("p.onnx", tmp_path, 2).act([0, 1], {}, None) == 1


def test_a_file_may_choose_the_action_itself(tmp_path: Path) -> None:
    onnx_files.constant(tmp_path / "p.onnx", np.array([2], np.int64), dtype=TensorProto.INT64)
    policy = load_policy("p.onnx", tmp_path)
    assert policy.act([0, 0], {}, None) == 2
    with pytest.raises(PolicyError, match="returned action 2, which action_mask forbids now"):
        policy.act([0, 0], {}, (True, True, False))


@pytest.mark.parametrize(
    ("state", "seq_lens"),
    [
        (("state_in_0", "state_out_0"), (1,)),
        (("state_in_0", "state_out_0"), ("batch",)),
        (("state_ins", "state_outs"), None),
        (("h", "hn"), None),
        (("h0", "hn"), None),
        (("memory_in", "memory_out"), None),
        (("memory", "170"), None),
        (("seq_lens", "170"), None),
    ],
)
def test_a_recurrent_file_remembers_until_the_next_episode(tmp_path: Path, state: Any, seq_lens: Any) -> None:
    """Shapes and their order tell which output is for which state: names differ among RLlib, PyTorch and others."""
    onnx_files.counter(tmp_path / "p.onnx", state=state, seq_lens=seq_lens)
    policy = load_policy("p.onnx", tmp_path)
    policy.reset(1)
    first = [policy.act([0, 0], {}, None) for _ in range(4)]
    policy.reset(1)
    assert (first, policy.act([0, 0], {}, None)) == ([0, 1, 2, 2], 0)


def test_a_policy_without_state_that_rllib_exported_plays(tmp_path: Path) -> None:
    """It has an input `state_ins` of one number, on which the actions do not depend."""
    nodes = [
        helper.make_node("MatMul", ["obs", "w"], ["output"]),
        helper.make_node("Identity", ["state_ins"], ["state_outs"]),
    ]
    onnx_files.save(
        tmp_path / "p.onnx",
        nodes,
        [("obs", ("batch_size", 2)), ("state_ins", ("batch_size",))],
        [("output", ("batch_size", 3)), ("state_outs", ("batch_size",))],
        {"w": np.array(WEIGHTS, np.float32)},
    )
    assert load_policy("p.onnx", tmp_path).act([0, 1], {}, None) == 1


# ---- files that cannot be used


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    assert refusal("policies/x.onnx", tmp_path) == "there is no file policies/x.onnx"
    onnx_files.linear(tmp_path / "policies/p.onnx", WEIGHTS)
    assert refusal("policies/x.onnx", tmp_path) == "there is no file policies/x.onnx; there are policies/p.onnx"


def test_a_file_outside_of_the_project_is_refused(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "p.onnx", WEIGHTS)
    (tmp_path / "project").mkdir()
    (tmp_path / "project/link.onnx").symlink_to(tmp_path / "p.onnx")
    for name in ("../p.onnx", str(tmp_path / "p.onnx"), "link.onnx"):
        assert refusal(name, tmp_path / "project") == f"{name} leads out of the project's folder"


@pytest.mark.parametrize("content", [b"", b"no ONNX", b"\x08\x07" * 40, b"\0" * 1000])
def test_a_file_that_is_no_onnx_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "p.onnx").write_bytes(content)
    assert refusal("p.onnx", tmp_path).startswith("p.onnx is no ONNX file that onnxruntime can read: ")


def test_a_file_for_observations_of_another_size_is_refused(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "p.onnx", WEIGHTS)
    assert refusal("p.onnx", tmp_path, space=Box(-1, 1, (16,))) == (
        "p.onnx takes observations of 2 numbers (its input 'obs'); the environment gives 16 numbers; "
        "export it for one such observation, or write a class with act() in agent.py that runs the file"
    )
    assert "gives 84 x 84 x 3;" in refusal("p.onnx", tmp_path, space=Box(0, 255, (84, 84, 3), np.uint8))
    onnx_files.linear(tmp_path / "batch.onnx", WEIGHTS, shape=(32, 2))
    assert "of 32 x 2 (its input 'obs'); the environment gives 2 numbers; export" in refusal("batch.onnx", tmp_path)


@pytest.mark.timeout(60)
def test_several_discrete_numbers_are_one_hot_one_after_the_other(tmp_path: Path) -> None:
    weights = np.zeros((1_000_003, 3))
    weights[999_999, 2] = weights[1_000_001, 1] = 1
    onnx_files.linear(tmp_path / "p.onnx", weights)
    policy = load_policy("p.onnx", tmp_path, space=MultiDiscrete([1_000_000, 3]))
    assert policy.act(np.array([999_999, 0]), {}, None) == 2
    assert policy.act(np.array([0, 1]), {}, None) == 1


def test_an_observation_without_numbers_gets_a_sentence(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "p.onnx", np.ones((2, 3)))
    around: list[Any] = []
    around.append(around)
    for seen in ({"in": around}, {"in": "left"}, {"in": object()}):
        with pytest.raises(PolicyError, match=r"^p\.onnx takes an observation of numbers, and this is none: "):
            load_policy("p.onnx", tmp_path).act(seen, {}, None)


def test_a_file_for_another_number_of_actions_is_refused(tmp_path: Path) -> None:
    onnx_files.linear(tmp_path / "p.onnx", WEIGHTS)
    assert refusal("p.onnx", tmp_path, 6) == (
        "p.onnx returns 3 numbers as 'output'; expected 6, one for each action, as its first output; export it so, or "
        "write a class with act() in agent.py that runs the file"
    )


def test_an_action_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    onnx_files.constant(tmp_path / "p.onnx", np.array([7], np.int64), dtype=TensorProto.INT64)
    assert refusal("p.onnx", tmp_path) == "p.onnx returned action 7; there are 0 to 2"


def test_values_of_nan_are_refused(tmp_path: Path) -> None:
    onnx_files.constant(tmp_path / "p.onnx", np.array([[0, np.nan, 1]], np.float32))
    assert refusal("p.onnx", tmp_path) == "p.onnx returned NaN instead of the actions' values"


def test_an_action_of_minus_infinity_is_never_drawn(tmp_path: Path) -> None:
    """A policy that masks actions itself gives them minus infinity."""
    onnx_files.constant(tmp_path / "p.onnx", np.array([[-np.inf, -np.inf, 1]], np.float32))
    policy = load_policy("sample:p.onnx", tmp_path)
    assert {policy.act([0, 0], {}, mask) for mask in (None, (True, False, True))} == {2}


def test_an_unknown_input_is_refused(tmp_path: Path) -> None:
    nodes = [helper.make_node("Add", ["obs", "speed"], ["output"])]
    onnx_files.save(tmp_path / "p.onnx", nodes, [("obs", (1, 3)), ("speed", (1, 3))], [("output", (1, 3))])
    assert refusal("p.onnx", tmp_path, space=Box(0, 1, (3,))) == (
        "p.onnx takes an input 'speed' of 3 numbers, which is neither an observation nor a recurrent state (no output "
        "has its shape); write a class with act() in agent.py that runs the file"
    )


def test_without_onnxruntime_the_error_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    onnx_files.linear(tmp_path / "p.onnx", WEIGHTS)
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    wanted = next(
        line for line in (ROOT / "requirements/dev.txt").read_text().split() if line.startswith("onnxruntime=")
    )
    assert refusal("p.onnx", tmp_path) == (
        f"p.onnx needs the package onnxruntime, which is not installed; write {wanted} into requirements.txt"
    )
    assert wanted == ONNXRUNTIME


# ---- after a lost server


def test_a_class_is_told_what_it_was_asked_and_what_it_chose_and_is_not_asked_again(tmp_path: Path) -> None:
    told: list[Any] = []

    class Partner:
        def act(self, observation: Any, info: Any) -> int:
            raise AssertionError("asked again")

        def resume(self, steps: Any) -> None:
            told.extend(steps)

    class Stateless:
        def act(self, observation: Any, info: Any) -> int:
            raise AssertionError("asked again")

    agent = agent_module(Partner=Partner, Stateless=Stateless)
    observed = [Observed([0, 1], {"t": 0}, None, 2), Observed([1, 1], {"t": 1}, None, None)]
    for name in ("Partner", "Stateless"):
        load(f"agent:{name}", tmp_path, agent, 3).resume(observed)
    assert told == [([0, 1], {"t": 0}, 2), ([1, 1], {"t": 1}, None)]


def test_a_resume_that_takes_other_values_is_refused(tmp_path: Path) -> None:
    class Partner:
        def act(self, observation: Any, info: Any) -> int:
            return 0

        def resume(self) -> None: ...

    with pytest.raises(PolicyError, match=r"resume of class Partner in agent.py takes other values; write resume\("):
        load("agent:Partner", tmp_path, agent_module(Partner=Partner), 3)


@pytest.mark.parametrize("spec", ["random", "p.onnx", "sample:p.onnx"])
def test_chance_and_files_go_on_as_if_there_had_been_no_other_server(tmp_path: Path, spec: str) -> None:
    onnx_files.counter(tmp_path / "p.onnx", state=("h", "hn"), seq_lens=None)
    lost, following = (load_policy(spec, tmp_path) for _ in range(2))
    mask = (True, True, True)
    lost.reset(5)
    observed = [Observed([0, 0], {}, mask, lost.act([0, 0], {}, mask)) for _ in range(2)]
    following.reset(5)
    following.resume([*observed])
    ahead = [[policy.act([0, 0], {}, mask) for _ in range(30)] for policy in (lost, following)]
    assert ahead[0] == ahead[1]


# ---- the thread


class PolicyByObservation:
    """A policy that takes the action that its observation names, or calls it."""

    def __init__(self) -> None:
        self.seeds: list[int] = []
        self.threads: set[str] = set()
        self.closed = threading.Event()

    def act(self, observation: Any, _info: Any, _mask: Any) -> int:
        self.threads.add(threading.current_thread().name)
        if callable(observation):
            observation()
        return observation if isinstance(observation, int) else 0

    def reset(self, seed: int) -> None:
        if seed < 0:
            raise RuntimeError("no such seed")
        self.seeds.append(seed)

    def resume(self, observed: Any) -> None:
        raise RuntimeError("no memory")

    def close(self) -> None:
        self.closed.set()

    def description(self) -> dict[str, Any]:
        return {}


@contextlib.asynccontextmanager
async def policy_thread() -> AsyncIterator[tuple[PolicyByObservation, PolicyThread, list[Any]]]:
    """Run a policy on its thread within the block; give the policy, the thread, and the list of its answers."""
    policy, answers = PolicyByObservation(), list[Any]()
    thread = PolicyThread(policy, lambda *answer: answers.append(answer), name="policy player_1")
    try:
        async with asyncio.timeout(PATIENCE):
            yield policy, thread, answers
    finally:
        thread.close()
        await asyncio.sleep(0)  # the event loop makes the calls that wait


async def test_answers_come_on_the_event_loop_in_the_order_of_the_questions() -> None:
    loops = []
    async with policy_thread() as (policy, thread, answers):
        told = thread._done
        thread._done = lambda *answer: (loops.append(asyncio.get_running_loop()), told(*answer))
        thread.reset(5)
        for number in range(3):
            thread.ask(number, number, {}, None)
        await until_async(lambda: len(answers) == 3)
    assert answers == [(0, 0, None), (1, 1, None), (2, 2, None)]
    assert (policy.seeds, policy.threads, len(loops)) == ([5], {"policy player_1"}, 3)
    assert policy.closed.wait(60)


async def test_a_policy_is_closed_also_if_the_event_loop_ends_as_it_answers() -> None:
    told = []

    class Ended:
        def is_closed(self) -> bool:
            return False  # it is when the policy tells its answer

        def call_soon_threadsafe(self, tell: Any) -> None:
            told.append(tell)
            raise RuntimeError("Event loop is closed")

    async with policy_thread() as (policy, thread, answers):
        thread._loop = Ended()  # type: ignore[assignment]
        thread.ask(1, 1, {}, None)
        await until_async(lambda: told)
    assert policy.closed.wait(60)
    assert answers == []


async def test_an_error_or_an_exit_of_a_policy_is_an_answer_too() -> None:
    def end() -> None:
        raise SystemExit(3)

    async with policy_thread() as (_, thread, answers):
        thread.ask(1, lambda: 1 / 0, {}, None)
        thread.ask(2, end, {}, None)
        thread.ask(3, 7, {}, None)
        await until_async(lambda: len(answers) == 3)
    assert [(ask, action, repr(error)) for ask, action, error in answers] == [
        (1, None, "ZeroDivisionError('division by zero')"),
        (2, None, "RuntimeError('SystemExit(3)')"),
        (3, 7, "None"),
    ]


async def test_a_failed_reset_or_resume_is_the_answer_until_the_next_reset() -> None:
    async with policy_thread() as (_, thread, answers):
        thread.reset(-1)
        thread.ask(1, 1, {}, None)
        thread.reset(2)
        thread.ask(2, 1, {}, None)
        thread.reset(2, [Observed(1, {}, None, 1)])
        thread.ask(3, 1, {}, None)
        await until_async(lambda: len(answers) == 3)
    said = [(ask, action, str(error)) for ask, action, error in answers]
    assert said == [(1, None, "no such seed"), (2, 1, "None"), (3, None, "no memory")]


async def test_a_policy_that_hangs_holds_up_nothing_but_its_answers() -> None:
    go_on = threading.Event()
    async with policy_thread() as (policy, thread, answers):
        thread.ask(1, go_on.wait, {}, None)
        began = time.monotonic()
        await asyncio.sleep(0.05)
        assert time.monotonic() - began < 5
        assert answers == []
        thread.close()
        go_on.set()
        await asyncio.to_thread(thread._thread.join, 10)
        await asyncio.sleep(0)
    assert answers == [], "nothing is told after close"
    assert policy.closed.is_set()


# ---- seeds


def test_each_player_has_a_seed_of_their_own_in_each_episode() -> None:
    assert policy_seed(1, "player_0") == 1_953_902_000
    seeds = {policy_seed(seed, f"player_{number}") for seed in range(50) for number in range(4)}
    assert len(seeds) == 200
    assert all(0 <= seed < 2**31 for seed in seeds)
