#!/usr/bin/python3
"""Runs commands for the host that has booted this machine: one line of JSON in, one out, per connection."""

import json
import socketserver
import subprocess

PORT = 5555


class Command(socketserver.StreamRequestHandler):
    """One command."""

    def handle(self) -> None:
        """Run it by a shell, with what it gets on its input; answer with its code and output."""
        request = json.loads(self.rfile.readline())
        try:
            done = subprocess.run(  # noqa: S603 - only the host reaches this machine
                ["/bin/bash", "-c", request["command"]],
                input=request["input"].encode("latin-1"),
                capture_output=True,
                timeout=request["timeout_s"],
                check=False,
            )
            reply = (done.returncode, done.stdout, done.stderr)
        except subprocess.TimeoutExpired as late:
            reply = (124, late.stdout or b"", b"still running")
        code, output, errors = reply
        text = {"code": code, "output": output.decode(errors="replace"), "errors": errors.decode(errors="replace")}
        self.wfile.write(json.dumps(text).encode() + b"\n")


class Agent(socketserver.ThreadingTCPServer):
    """Listens for the host."""

    allow_reuse_address = True
    daemon_threads = True


if __name__ == "__main__":
    Agent(("0.0.0.0", PORT), Command).serve_forever()  # noqa: S104 - restricted to the host by QEMU
