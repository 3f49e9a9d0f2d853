"""The chain and the jobs as Prefect flows."""

import os
import tempfile
from pathlib import Path

# Prefect reads these when it is first imported. Its log goes to its own server; the terminal shows ours.
os.environ.setdefault("PREFECT_LOGGING_LEVEL", "CRITICAL")
os.environ.setdefault("PREFECT_SERVER_LOGGING_LEVEL", "CRITICAL")
# It gives every library's log to the terminal, too, and that of its own services when that is no more.
os.environ.setdefault("PREFECT_LOGGING_ROOT_LEVEL", "CRITICAL")
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
os.environ.setdefault("DO_NOT_TRACK", "1")
# A flow without a server starts one of its own, which takes its time on a busy machine.
os.environ.setdefault("PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS", "180")
if "PREFECT_HOME" not in os.environ and not os.access(Path.home(), os.W_OK):
    # Users share the folder of temporary files, but on Windows, which doesn't number them.
    user = f"-{os.getuid()}" if hasattr(os, "getuid") else ""
    os.environ["PREFECT_HOME"] = str(Path(tempfile.gettempdir()) / f"prefect{user}")
