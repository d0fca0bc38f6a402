"""A server that only listens: `local` runs it in the contract tests instead of a trial."""

import http.server
import json
import signal
import sys


class Healthy(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
server = http.server.HTTPServer(("127.0.0.1", 0), Healthy)
print(json.dumps({"port": server.server_port}), flush=True)
server.serve_forever()
