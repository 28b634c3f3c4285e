"""Sweeps over a loop that runs within a second: 2 m, sees all, 15 frames."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.loop.small_loop import SMALL
from tests.stages.command_line import type_in

from nlcwfs.studies.study_table import StudyTable

QUICK = [*SMALL, "loop.sensor=ideal", "loop.seconds=0.03"]

# A test run in the background of a shell is deaf to Ctrl-C, and its children inherit that: hear it again.
HEARING = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from nlcwfs.cli import main; main()"


def written(folder: Path, body: str = "", settings=QUICK) -> Path:
    """A folder with `sweep.toml`."""
    folder.mkdir(parents=True, exist_ok=True)
    head = f'question = "How fast?"\nset = {json.dumps(settings)}\n'
    (folder / "sweep.toml").write_text(head + body, encoding="utf-8")
    return folder


def swept(folder: Path, *words):
    """The result of the command."""
    return type_in("sweep", folder, *words)


def rows_in(folder: Path) -> dict:
    """Rows of a table by the names of their points."""
    return {str(row["point"]): row for row in StudyTable(folder / "results.ecsv", key="point").rows}


def numbers(row: dict) -> dict:
    """What must be the same whoever computes."""
    return {name: value for name, value in row.items() if not name.endswith("seconds")}


class Sweeping:
    """`nlcwfs sweep` as a process of its own, with children that hear the same Ctrl-C."""

    def __init__(self, *words) -> None:
        command = [sys.executable, "-c", HEARING, "sweep", *map(str, words)]
        environment = os.environ | {"PYTHONUNBUFFERED": "1"}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        self.process = subprocess.Popen(command, env=environment, start_new_session=True, **pipes)
        self.said = ""

    def read_until(self, beginning: str) -> None:
        """Wait for a line."""
        for line in self.process.stdout:
            self.said += line
            if line.startswith(beginning):
                return
        raise AssertionError(f"ended without {beginning}:\n{self.said}")

    def press_ctrl_c(self) -> None:
        """As a terminal does: every process of the group hears it."""
        os.killpg(self.process.pid, signal.SIGINT)

    def end(self) -> int:
        """Exit code."""
        self.said += self.process.communicate(timeout=100)[0]
        return self.process.returncode

    def left_over(self) -> list[int]:
        """Processes of the group that still live, after some time to go."""
        for _ in range(100):
            alive = self._alive()
            if not alive:
                break
            time.sleep(0.1)
        return alive

    def _alive(self) -> list[int]:
        listed = subprocess.run(["ps", "-eo", "pid,pgid,stat"], capture_output=True, text=True, check=True).stdout
        rows = [line.split() for line in listed.splitlines()[1:]]
        return [int(pid) for pid, group, stat in rows if int(group) == self.process.pid and not stat.startswith("Z")]
