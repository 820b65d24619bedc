"""One instance of an FMU for co-simulation, in this process or in one of its own.

It imports nothing of jaxouter, for it is also the program of those processes: a line in (`reset`, or r~), a line out.
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

SAID = 3  # messages of an FMU that are kept
DISCARD = 2  # status from which on a message tells of a failure; also of what a step gives that is none
TERMINATED = 3  # fmi2StatusKind


class FmuError(Exception):
    """An FMU did not do what it was asked for: what failed, and what the FMU said of it."""


class Setup(NamedTuple):
    """How an FMU is run; plain values."""

    folder: str  # where it is extracted
    given: str  # variable that is r~
    seen: str  # variable that is y
    start: float  # time at which an episode begins
    step: float  # communication step
    anew: bool = False  # instantiate for each episode, as it can't be reset


@lru_cache(maxsize=4)
def _described(folder: str) -> Any:
    from fmpy import read_model_description

    return read_model_description(folder, validate=False)


_SAID: deque[str] = deque(maxlen=SAID)


class _Newest:
    """FMPy lets all instances talk through the callbacks of the newest, which must outlive it."""

    callbacks: Any = None


def _log(*said: Any) -> None:
    """Logger of FMI 2 and of FMI 3, whose last three arguments are status, category and message."""
    status, _, message = said[-3:]
    if status >= DISCARD and message:
        _SAID.append(message.decode("utf-8", "replace").strip())


class Instance:
    """An FMU between two of its variables; nan from where it ends the episode by itself."""

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
        del seed  # an FMU draws nothing
        return self._heard(self._reset)

    def step(self, r_tilde: float) -> float:
        """One communication step; raises FmuError."""
        return math.nan if self.ended else self._heard(lambda: self._step(r_tilde))

    def free(self) -> None:
        """Let the instance go."""
        fmu, self._fmu, self._begun = self._fmu, None, False
        if fmu is not None:
            with suppress(Exception):  # one that has failed need not end well
                fmu.terminate()
            with suppress(Exception):
                fmu.freeInstance()

    def _heard(self, act: Any) -> float:
        """What `act` gives; what it raises comes with what the FMU said."""
        _SAID.clear()
        try:
            return act()
        except Exception as error:
            text = " ".join([str(error).rstrip("."), *(f"- the FMU: {message}" for message in _SAID)])
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
        """Do the step; whether the FMU wants to end."""
        at = self._setup.start + self._done * self._setup.step
        if self._three:
            return bool(self._fmu.doStep(at, self._setup.step)[1])
        from ctypes import byref, c_int

        from fmpy.fmi1 import FMICallException

        try:
            self._fmu.doStep(at, self._setup.step)
        except FMICallException as error:  # FMI 2 has no other way to say so
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
    """An FMU in a process of its own, for one that can be instantiated once in a process."""

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._process: subprocess.Popen[str] | None = None
        self._end: Callable[[], Any] = lambda: None
        self._each = False  # a process for each episode
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
        # -P: modules beside this file are none of the program's.
        program = [sys.executable, "-P", __file__, json.dumps(self._setup)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(program, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True)
        self._end = weakref.finalize(self, _killed, self._process)  # also as the interpreter ends
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
        with suppress(OSError):  # it has ended
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the FMU prints is no answer
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
