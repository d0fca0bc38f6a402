"""Modules that tests and benches share. The product imports none of them, and they import neither `tests` nor `bench`.

Events and requests
    `aws_events`      builds every event that a function gets: HTTP, queue, ECS; reads whole payloads from `tests/events`
    `visitors`        `Browser` and `Program` send a participant's requests to `next_step`, in the same process
    `browser`         shows the game page in a real Chromium
    `gym_server`      a server of environments as a process, and a client that sends text
    `files`           writes the files of a folder
    `onnx_files`      writes small policies as ONNX files
    `certificates`    a certificate authority, which issues certificates
    `ports`           finds a free port for a server that a test starts again at the same port
    `studies`         small projects
    `derived`         computes tokens and project secrets from stored documents
    `servers`         starts, registers and stops servers without events

Platforms, from the fastest to the one most like AWS; `fake_platform` and `moto_world` pass the contract of the ports (`tests/contract`)
    `fake_platform`   the five ports in memory; time and messages move when the test says so. For services
    `simulation/`     AWS with quotas, latencies, lost and late events on a `GreenletClock`. For crowds, and for the bench
    `moto_world`      the adapters of `hippodrome/control/aws` on moto; each call is judged by the role of its function (`iam/`)
    `moto_study`      the example study on `moto_world`; the test delivers messages
    `strict_s3`       an HTTP server that checks presigned requests as S3 does
    `ministack/`      the whole stack on the emulator, in processes of its own

Time and tasks
    `clock`           the clock of all simulations: the time, and the calls that are due; code may wait on `simulation/clock.py`
    `tasks`           a Fargate task in memory: its states, and the event of each. (In `fake_platform` a task is only its request)

Faults
    `port_faults`     at a call of a port: the call is refused, loses its reply, or the function crashes before or after it
    `power_cut`       a disk that loses what was not synced

How much and how fast
    `async_tests`     the hook with which tests may be coroutine functions
    `waiting`         `until` waits until a condition is true
    `quiet_log`       switches the log off for a block
    `exploration`     how many examples and cases `make test` and `make hunt` take
    `processes`       starts `python -m …`
    `held_study`      a study that a test runs in a process of its own
    `botocore_sessions` sessions of botocore that read the description of a service once per process
    `template`        the resources of `infra/template.yml`
    `imports`         the modules that a Python file imports
"""
