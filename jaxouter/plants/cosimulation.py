"""One instance of an FMU for co-simulation, in this process or in a separate one.

This module imports nothing from jaxouter, as it is also the program of the separate processes: one line in (`reset`,
or r~), one line out.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from typing import Any, NamedTuple

MESSAGES = 3  # newest messages of an FMU that are kept
DISCARD = 2  # fmi2Discard: messages of this status or above report a failure; a step may return it to end
TERMINATED = 3  # fmi2StatusKind


class FmuError(Exception):
    """An FMU failed: the error, and the messages the FMU logged."""


class Setup(NamedTuple):
    """How to run an FMU; plain values."""

    folder: str  # of the extracted FMU
    given: str  # name of the variable for r~
    seen: str  # name of the variable for y
    start: float  # time at the start of an episode
    step: float  # communication step
    anew: bool = False  # make a new instance for each episode, as it can't be reset


@lru_cache(maxsize=4)
def _described(folder: str) -> Any:
    from fmpy import read_model_description

    return read_model_description(folder, validate=False)


_MESSAGES: deque[str] = deque(maxlen=MESSAGES)


class _Newest:
    """FMPy routes the messages of all instances to the callbacks of the newest, so these must outlive it."""

    callbacks: Any = None


def _log(*arguments: Any) -> None:
    """Logger for FMI 2 and FMI 3; the last three arguments are status, category and message."""
    status, _, message = arguments[-3:]
    if status >= DISCARD and message:
        _MESSAGES.append(message.decode("utf-8", "replace").strip())


class Instance:
    """An FMU from one input to one output; y is nan after the FMU has ended the episode by itself."""

    def __init__(self, setup: Setup) -> None:
        description = _described(setup.folder)
        references = {variable.name: variable.valueReference for variable in description.modelVariables}
        self._setup, self._description = setup, description
        self._input, self._output = [references[setup.given]], [references[setup.seen]]
        self._three = description.fmiVersion.startswith("3")
        self._fmu: Any = None
        self._begun, self._done = False, 0
        self.ended: str | None = None

    def reset(self, seed: int) -> float:
        """Begin an episode; raises FmuError."""
        del seed  # an FMU has no random numbers
        return self._with_messages(self._reset)

    def step(self, r_tilde: float) -> float:
        """One communication step; raises FmuError."""
        return math.nan if self.ended else self._with_messages(lambda: self._step(r_tilde))

    def free(self) -> None:
        """Free the instance."""
        fmu, self._fmu, self._begun = self._fmu, None, False
        if fmu is not None:
            with suppress(Exception):  # a failed FMU may not terminate cleanly
                fmu.terminate()
            with suppress(Exception):
                fmu.freeInstance()

    def _with_messages(self, act: Any) -> float:
        """The result of `act`; its errors are raised with the FMU's messages."""
        _MESSAGES.clear()
        try:
            return act()
        except Exception as error:
            text = " ".join([str(error).rstrip("."), *(f"- the FMU: {message}" for message in _MESSAGES)])
            raise FmuError(text) from error

    def _reset(self) -> float:
        if self._begun and self._setup.anew:
            self.free()
        if self._fmu is None:
            from fmpy import instantiate_fmu

            folder, description = self._setup.folder, self._description
            self._fmu = instantiate_fmu(folder, description, "CoSimulation", logger=_log)
            _Newest.callbacks = self._fmu.callbacks
        elif self._begun:
            self._fmu.reset()
        self._begun, self._done, self.ended = True, 0, None
        if self._three:
            self._fmu.enterInitializationMode(startTime=self._setup.start)
        else:
            self._fmu.setupExperiment(startTime=self._setup.start)
            self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        return self._y()

    def _step(self, r_tilde: float) -> float:
        (self._fmu.setFloat64 if self._three else self._fmu.setReal)(self._input, [r_tilde])
        if self._ends():
            self.ended = f"the FMU ended the simulation in control step {self._done + 1}"
        self._done += 1
        return math.nan if self.ended else self._y()

    def _ends(self) -> bool:
        """Do one step; whether the FMU asks to end the simulation."""
        at = self._setup.start + self._done * self._setup.step
        if self._three:
            return bool(self._fmu.doStep(at, self._setup.step)[1])
        from ctypes import byref, c_int

        from fmpy.fmi1 import FMICallException

        try:
            self._fmu.doStep(at, self._setup.step)
        except FMICallException as error:  # the only way an FMI 2 FMU can ask to end
            ends = c_int(0)
            if error.status == DISCARD:
                with suppress(Exception):
                    self._fmu.fmi2GetBooleanStatus(self._fmu.component, TERMINATED, byref(ends))
            if not ends.value:
                raise
            return True
        return False

    def _y(self) -> float:
        return float((self._fmu.getFloat64 if self._three else self._fmu.getReal)(self._output)[0])


class Apart:
    """An FMU in a separate process, for FMUs that can be instantiated only once per process."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._process: subprocess.Popen[str] | None = None
        self._end: Callable[[], Any] = lambda: None
        self._each = False  # a new process for each episode
        self.ended: str | None = None

    def reset(self, seed: int) -> float:
        """Begin an episode; raises FmuError."""
        del seed
        if self._process is not None and not self._each:
            try:
                return self._ask("reset")
            except FmuError:
                self._each = True
        self.free()
        # -P: keep the modules next to this file off the program's path.
        program = [sys.executable, "-P", __file__, json.dumps(self._setup)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(program, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
        self._end = weakref.finalize(self, _killed, self._process)  # runs at interpreter exit too
        return self._ask("reset")

    def step(self, r_tilde: float) -> float:
        """One communication step; raises FmuError."""
        return self._ask(repr(r_tilde))

    def free(self) -> None:
        """End the process."""
        self._process = None
        self._end()

    def _ask(self, what: str) -> float:
        assert self._process is not None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        line = ""
        with suppress(OSError):  # the process has ended
            self._process.stdin.write(what + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline()
        if not line:
            raise FmuError(f"the process of the FMU ended with status {self._process.wait()}")
        y, self.ended, error = json.loads(line)
        if error is not None:
            raise FmuError(error)
        return y


def _killed(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.communicate()


def main() -> None:
    """The program: one instance, until its input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # keep what the FMU prints out of the answers
    instance = Instance(Setup(*json.loads(sys.argv[1])))
    for line in sys.stdin:
        y, error = math.nan, None
        try:
            y = instance.reset(0) if line == "reset\n" else instance.step(float(line))
        except FmuError as failure:
            error = str(failure)
        answers.write(json.dumps([y, instance.ended, error]) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
