"""Starts the researcher's agent and decides by which of the two adapters it is called."""

from __future__ import annotations

from collections.abc import Sequence

from trial.agent import environments
from trial.agent.agent import AgentAdapter, AgentError
from trial.agent.joint import JointAdapter


def start(adapter: AgentAdapter, players: Sequence[str] = ()) -> AgentAdapter | JointAdapter:
    """Start the agent's game. The adapter itself if there is one player, else one for several.

    `players` are the names in `trial.players`. Several play if `start` returned such an environment (or the agent keeps
    it in its attribute `env`), if the agent has `possible_agents`, or if `players` has more than one name. But a class
    with a `step` of its own is called for one player unless `players` or its own `possible_agents` say otherwise: it
    may play the others itself. Raises AgentError, and whatever the researcher's code raises.
    """
    adapter.begin()
    own = environments.player_keys(adapter.agent)
    keys = own or environments.player_keys(adapter.env)
    if not own and adapter.steps_itself and len(players) < 2:
        keys = []
    if not keys and len(players) > 1:
        keys = list(players)
    if not keys:
        adapter.name_actions()
        return adapter
    env = adapter.env
    about = adapter.agent if env is None else env
    try:
        found = environments.players_of(
            about, keys, adapter.configured, of_env=env is not None, stepped=not adapter.steps_itself
        )
    except environments.PlayersUnknown as error:
        raise AgentError(str(error)) from None
    return JointAdapter(adapter, found, environments.turns(env))
