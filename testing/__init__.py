"""What tests and benches share. Nothing in the product imports it, and it imports neither `tests` nor `bench`.

Events and requests
    `aws_events`      builds every event that a function gets: HTTP, queue, ECS; reads whole payloads from `tests/events`
    `visitors`        `Browser` and `Program` send a participant's requests and read pages, in the same process
    `browser`         the same in a real Chromium
    `files`           writes the files of a folder
    `certificates`    an authority and what it issues
    `ports`           a port for a server that is started again where it was
    `studies`         small projects; `derived` what the installation derives from its secret
    `servers`         starts, registers and stops servers without events

Platforms, from the fastest to the nearest to AWS; `fake_platform` and `moto_world` pass the contract of the ports (`tests/contract`)
    `fake_platform`   the five ports in memory; time and messages move when the test says so. For services
    `simulation/`     AWS with quotas, latencies, lost and late events on a `GreenletClock`. For crowds, and for the bench
    `moto_world`      the adapters in `hippodrome/aws` on moto, each call judged by the function's role (`iam/`)
    `moto_study`      the example study on it; the test delivers messages
    `clocked_moto`    the same where time passes, queues deliver again, and the sweep runs
    `strict_s3`       an HTTP server that takes presigned requests as S3 does
    `ministack/`      the whole stack on the emulator, in processes of its own

Time and tasks
    `clock`           the one clock: seconds, and what is due when; `simulation/clock.py` adds code that waits
    `tasks`           the one Fargate task: its states, and the event of each. (In `fake_platform` nothing happens by itself: a task
                      there is no more than its request)

Faults, one module for each height at which they are injected
    `port_faults`     at a call of a port: refused, reply lost, crash before or after, waiting
    `aws_faults`      below botocore, in the HTTP answers of AWS
    `os_faults`       at the system's calls of one machine; `power_cut` loses what was not synced

How much and how fast
    `waiting`         `until` something is true
    `quiet_log`       the log stands still meanwhile
    `exploration`     how many examples and cases `make test` and `make hunt` take
    `preloaded`       processes of `python -m …` that begin with their imports done; `held_study` and `held_rehearsal` use it
    `memoized_aws`    botocore and moto compute once per process what they would compute for each client and call
    `template`        the resources of `infra/template.yml`
"""
