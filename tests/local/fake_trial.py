"""Stands for `python -m hippodrome.trial`: listens, answers /healthz, and ends as its environment says."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, HTTPServer


class Health(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        pass


def main() -> int:
    seconds, status = float(os.environ.get("FAKE_SECONDS", "60")), int(os.environ.get("FAKE_STATUS", "0"))
    if os.environ.get("FAKE_STUBBORN"):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    else:
        signal.signal(signal.SIGTERM, lambda *_: os._exit(status))
    if os.environ.get("FAKE_SILENT"):
        time.sleep(seconds)
        return status
    server = HTTPServer((os.environ["HOST"], int(os.environ["PORT"])), Health)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    told = {key: os.environ[key] for key in ("STORE", "SPOOL", "TLS", "AGENT_DIR", "TOKEN")}
    print(f"{json.dumps({'port': server.server_port})}\n{json.dumps(told)}", flush=True)
    time.sleep(seconds)
    return status


if __name__ == "__main__":
    sys.exit(main())
