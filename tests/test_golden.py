"""Short trainings, exports and a comparison give what they gave before the code was last restructured (slow)."""

import os
import subprocess
import sys

import pytest

from tests.load import ROOT


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_results_are_the_golden_ones():
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    command = [sys.executable, "scripts/golden.py"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
