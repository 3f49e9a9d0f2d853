"""A folder from which flows and schedules are run on a Prefect server of its own, on loopback."""

import json
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from commands import free_of_prefect, gone, here, python

from flows.server import server
from vinemap.compute.processes import descendants

SERVE = """
import json, sys
from flows.serving import serve
from vinemap.terminal import plain_errors
with plain_errors():
    serve("job.job", **{"cron": "0 2 * * *", "timezone": "Europe/Rome"} | json.loads(sys.argv[1]))
"""


def wait(condition, *, patience=120):
    """Return what a condition gives as soon as that is true."""
    deadline = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < deadline, "it never came true"
        time.sleep(0.1)
    return found


class Place:
    """A folder from which flows and schedules are run, with a server on a port of its own."""

    def __init__(self, folder):
        self.folder = folder
        with socket.create_server(("127.0.0.1", 0)) as one:
            self.port = one.getsockname()[1]
        self.api = f"http://127.0.0.1:{self.port}/api"
        self.environment = here(free_of_prefect(), folder) | {
            "PREFECT_API_URL": self.api,
            "PREFECT_RUNNER_POLL_FREQUENCY": "1",
            "PREFECT_SERVER_SERVICES_SCHEDULER_RECENT_DEPLOYMENTS_LOOP_SECONDS": "1",
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "DO_NOT_TRACK": "1",
        }

    def start(self, said, *command, **options):
        """Start a command, or the flow ``job`` on a schedule."""
        command = command or ("-c", SERVE, json.dumps({"parameters": {}} | options))
        return subprocess.Popen(
            [sys.executable, *command], cwd=self.folder, env=self.environment, stdout=said, stderr=subprocess.STDOUT
        )

    def fails(self, **options):
        with (self.folder / "failed.txt").open("w+b") as said:
            process = self.start(said, **options)
            assert process.wait(60) == 2
            said.seek(0)
            return said.read().decode()

    def server(self, home):
        """A server and no schedule, for the context in which this is used."""
        return server(self.api, home)

    @contextmanager
    def serving(self, *command, **options):
        """Give a process that serves, and what it says; nothing of it is left."""
        path = self.folder / "said.txt"
        with path.open("wb") as said, self.start(said, *command, **options) as process:
            try:
                while "Next run" not in path.read_text():
                    assert process.poll() is None, path.read_text()
                    time.sleep(0.1)
                yield process, path
            finally:
                processes = [process.pid, *descendants(process.pid)]
                process.terminate()
                try:
                    process.wait(60)
                finally:
                    process.kill()
                wait(lambda: all(map(gone, processes)))

    def ask(self, path, body):
        request = Request(self.api + path, json.dumps(body).encode(), {"Content-Type": "application/json"})

        def answer():
            try:
                with urlopen(request, timeout=30) as given:
                    return [json.load(given)]
            except HTTPError as error:
                # Its database is busy: Prefect's own clients ask again, too.
                if error.code != 503:
                    raise
                error.close()
                return None

        return wait(answer)[0]

    def runs(self, state=None):
        chosen = {"flow_runs": {"state": {"type": {"any_": [state]}}}} if state else {}
        return self.ask("/flow_runs/filter", chosen | {"sort": "EXPECTED_START_TIME_ASC"})

    def run(self, *words, cwd):
        """Run ``-m`` a module or ``-c`` a program whose flows the server has."""
        return python(*words, cwd=cwd, environment=self.environment | {"PREFECT_HOME": str(self.folder / "client")})
