"""The modules that are mutated (the pure core, and services), and the quick tests that judge the mutants of each."""

from __future__ import annotations

SERVICES = (
    "hippodrome/servers/test_servers",
    "hippodrome/servers/warm/test_warm_servers",
    "hippodrome/servers/warm/test_races",
    "hippodrome/limits/test_limits",
    "hippodrome/servers/test_dns",
    "hippodrome/servers/test_sweep",
    "hippodrome/participants/test_relays",
    "hippodrome/servers/test_causes",
    "hippodrome/test_metrics",
    "hippodrome/servers/test_sessions",
    "hippodrome/servers/test_stops",
    "hippodrome/lobby/test_lobby_servers",
)
SESSIONS = (
    "trial/core/test_session",
    "trial/core/test_session_hidden",
    "trial/core/test_session_flapping",
    "trial/core/test_presence",
)
TRIALS = (
    "trial/core/test_decisions",
    "trial/core/test_turns",
    "trial/core/test_keys",
    "trial/core/test_flow_control",
    *SESSIONS,
)
SECTION = (
    "protocol/test_trial",
    "protocol/test_keyboard",
    "hippodrome/config/test_config_keys",
    "hippodrome/config/test_trial_section",
)
TESTED_BY: dict[str, tuple[str, ...]] = {
    "hippodrome/servers/causes.py": (
        "hippodrome/servers/test_causes",
        "hippodrome/servers/test_servers",
        "hippodrome/test_metrics",
    ),
    "hippodrome/servers/termination.py": SERVICES,
    "hippodrome/participants/forms.py": ("hippodrome/participants/test_forms", "hippodrome/participants/test_journey"),
    "hippodrome/participants/fragments.py": (
        "hippodrome/participants/test_fragments",
        "hippodrome/participants/test_pages",
    ),
    "hippodrome/participants/sandbox.py": (
        "hippodrome/participants/test_fragments",
        "hippodrome/participants/test_pages",
    ),
    "hippodrome/servers/warm/handover.py": (
        "hippodrome/servers/warm/test_warm_servers",
        "hippodrome/servers/warm/test_races",
        "hippodrome/limits/test_limits",
    ),
    "hippodrome/http.py": (
        "hippodrome/test_http",
        "hippodrome/participants/test_forms",
        "hippodrome/participants/test_journey",
    ),
    "hippodrome/model/ids.py": (
        "hippodrome/model/test_ids",
        "hippodrome/participants/test_journey",
        "hippodrome/model/test_participant",
        "hippodrome/model/test_messages",
    ),
    "hippodrome/participants/answers.py": (
        "hippodrome/participants/test_journey",
        "protocol/test_both_ends",
        "hippodrome/participants/test_repeated_forms",
    ),
    "hippodrome/participants/journey.py": (
        "hippodrome/participants/test_journey",
        "hippodrome/participants/test_journey_files",
        "hippodrome/participants/test_repeated_forms",
        "hippodrome/participants/test_previews",
        "hippodrome/limits/test_limits",
        "hippodrome/participants/test_lobby_pages",
        "hippodrome/test_one_bad_entry",
    ),
    "hippodrome/limits/rules.py": (
        "hippodrome/limits/test_rules",
        "hippodrome/limits/test_limits",
        "hippodrome/servers/warm/test_warm_servers",
    ),
    "hippodrome/lobby/decisions.py": ("hippodrome/lobby/test_rules", "hippodrome/lobby/test_rules_machine"),
    "hippodrome/lobby/rules.py": ("hippodrome/lobby/test_rules", "hippodrome/lobby/test_rules_machine"),
    "hippodrome/lobby/matchmaking.py": ("hippodrome/lobby/test_rules", "hippodrome/lobby/test_rules_machine"),
    "hippodrome/lobby/servers_ahead.py": ("hippodrome/lobby/test_rules", "hippodrome/lobby/test_rules_machine"),
    "hippodrome/model/messages.py": ("hippodrome/model/test_messages", "hippodrome/participants/test_relays"),
    "hippodrome/servers/dns.py": ("hippodrome/servers/test_dns", *SERVICES),
    "hippodrome/participants/frame.py": ("hippodrome/participants/test_pages", "hippodrome/participants/test_scripts"),
    "hippodrome/participants/pages.py": (
        "hippodrome/participants/test_pages",
        "hippodrome/participants/test_journey",
        "hippodrome/participants/test_lobby_pages",
    ),
    "hippodrome/model/participant.py": (
        "hippodrome/model/test_participant",
        "hippodrome/participants/test_repeated_forms",
        "hippodrome/participants/test_journey",
    ),
    "hippodrome/limits/slots.py": (
        "hippodrome/limits/test_limits",
        "hippodrome/servers/warm/test_warm_servers",
        "hippodrome/participants/test_journey",
    ),
    "hippodrome/servers/warm/pools.py": (
        "hippodrome/servers/warm/test_warm_servers",
        "hippodrome/servers/test_sweep_garbage",
        "hippodrome/servers/warm/test_races",
        "hippodrome/limits/test_limits",
    ),
    "hippodrome/participants/previews.py": ("hippodrome/participants/test_previews",),
    "hippodrome/model/project.py": (
        "hippodrome/model/test_project",
        "hippodrome/participants/test_journey",
        "hippodrome/test_registry",
        "hippodrome/model/test_participant",
        "hippodrome/servers/test_servers",
        "hippodrome/servers/warm/test_warm_servers",
        "hippodrome/limits/test_limits",
        "hippodrome/participants/test_pages",
    ),
    "hippodrome/model/server.py": ("hippodrome/model/test_server", *SERVICES),
    "hippodrome/model/warm_pool.py": (
        "hippodrome/model/test_warm_pool",
        "hippodrome/servers/warm/test_warm_servers",
        "hippodrome/servers/warm/test_races",
    ),
    "hippodrome/servers/leftovers.py": ("hippodrome/servers/test_leftovers", "hippodrome/servers/test_sweep"),
    "hippodrome/servers/replacement.py": ("hippodrome/servers/test_replacement", *SERVICES),
    "hippodrome/servers/start.py": ("hippodrome/servers/test_task_requests", *SERVICES),
    "hippodrome/servers/sweep.py": (
        "hippodrome/servers/test_sweep",
        "hippodrome/servers/test_sweep_garbage",
        "hippodrome/servers/test_sweep_strangers",
        *SERVICES,
    ),
    "hippodrome/participants/waiting.py": (
        "hippodrome/participants/test_waiting",
        "hippodrome/participants/test_journey",
    ),
    "hippodrome/model/matching.py": ("hippodrome/lobby/test_lobby", "hippodrome/config/test_sessions"),
    "hippodrome/model/memberships.py": ("hippodrome/model/test_memberships", "hippodrome/lobby/test_lobby"),
    "hippodrome/model/sessions.py": ("hippodrome/servers/test_sessions",),
    "protocol/session.py": ("protocol/test_session", "hippodrome/servers/test_sessions"),
    "hippodrome/config/hippo.py": ("hippodrome/config/test_hippo", "hippodrome/config/test_hippo_pages"),
    "protocol/trial.py": (
        "hippodrome/config/test_registration",  # compares the schema
        "protocol/test_trial",
        "protocol/test_keyboard",
        "hippodrome/config/test_trial_section",
        "hippodrome/config/test_project_folder",
        "hippodrome/config/test_step_files",
        "hippodrome/config/test_config_file",
        "hippodrome/config/test_config_keys",
    ),
    "protocol/trial_check.py": (*SECTION, "trial/test_settings"),
    "protocol/trial_rules.py": SECTION,
    "protocol/key_maps.py": ("protocol/test_keyboard", "hippodrome/config/test_trial_section"),
    "protocol/values.py": (
        "protocol/test_values",
        "hippodrome/config/test_trial_section",
        "hippodrome/config/test_project_folder",
        "hippodrome/config/test_step_files",
        "hippodrome/config/test_config_file",
        "hippodrome/config/test_config_keys",
        "hippodrome/config/test_registration",
    ),
    "trial/core/controls.py": ("trial/core/test_wire_messages", "trial/core/test_controls", "trial/core/test_keys"),
    "trial/pictures/frames.py": ("trial/core/test_wire_messages", "trial/pictures/test_frames"),
    "trial/core/clients.py": TRIALS,
    "trial/core/trial.py": TRIALS,
    "trial/core/records.py": TRIALS,
    "trial/core/recording.py": TRIALS,
    "trial/core/participants.py": TRIALS,
    "trial/core/beginning.py": TRIALS,
    "trial/core/steps.py": TRIALS,
    "trial/core/ending.py": TRIALS,
    "trial/core/commands.py": ("trial/core/test_wire_messages", *TRIALS),
    "trial/core/agent_call.py": TRIALS,
    "trial/core/choices.py": (
        "trial/core/test_turns",
        "trial/core/test_progress",
        "trial/core/test_controls",
        "trial/core/test_progress_any_order",
        "trial/core/test_keys",
    ),
    "trial/core/presence.py": SESSIONS,
    "trial/core/session.py": SESSIONS,
    "trial/core/message_log.py": TRIALS,
    "trial/core/timing.py": (*TRIALS, "trial/core/test_progress", "trial/core/test_progress_any_order"),
    "trial/core/progress.py": ("trial/core/test_progress", "trial/core/test_progress_any_order", *TRIALS),
    "trial/core/messages.py": ("trial/core/test_wire_messages", "trial/core/test_messages"),
    "trial/recordings/resume.py": ("trial/recordings/test_recorded",),
    "trial/recordings/recording.py": (
        "trial/recordings/test_disk",
        "trial/recordings/test_recorded",
        "trial/recordings/test_recording",
    ),
    "trial/wire/reconnects.py": ("trial/wire/test_reconnects",),
    "trial/wire/round_trips.py": ("trial/wire/test_round_trips",),
    "trial/server/watchdog.py": ("trial/core/test_wire_messages", "trial/server/test_watchdog"),
}


def concerned(module: str) -> list[str]:
    """Return the files of tests that judge a module's mutants, the most likely to kill one first."""
    names = dict.fromkeys(TESTED_BY[module])
    return [f"tests/{name}.py" for name in names]
