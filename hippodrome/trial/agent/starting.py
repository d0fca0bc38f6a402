"""Starts the researcher's agent, and decides whether it has one player (`AgentAdapter`) or several (`JointAdapter`)."""

from __future__ import annotations

from collections.abc import Sequence

from hippodrome.trial.agent import environments
from hippodrome.trial.agent.agent import AgentAdapter, AgentError
from hippodrome.trial.agent.joint import JointAdapter


def start(adapter: AgentAdapter, players: Sequence[str] = ()) -> AgentAdapter | JointAdapter:
    """Start the agent's game. Return the adapter itself if the game has one player, else a JointAdapter.

    `players` are the names in `trial.players`. The game has several players if the environment (`adapter.env`) or the
    agent has `possible_agents`, or if `players` has more than one name. But an agent with a `step` of its own may play
    the others itself: its game has one player unless `players` or its own `possible_agents` name several. Raises
    AgentError, and whatever the researcher's code raises.
    """
    adapter.start(players)
    env = adapter.env
    keys = environments.player_keys(adapter.agent)
    if not keys and (len(players) > 1 or not adapter.steps_itself):
        keys = environments.player_keys(env)
    if not keys and len(players) > 1:
        keys = list(players)
    if not keys:
        adapter.name_actions()
        return adapter
    try:
        found = environments.players_of(
            adapter.agent if env is None else env, keys, adapter.configured_actions, stepped=not adapter.steps_itself
        )
    except environments.PlayersUnknown as error:
        raise AgentError(str(error)) from None
    return JointAdapter(adapter, found)
