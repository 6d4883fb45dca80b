"""Development kits of data sets, which made-up samples are held against: in an environment of their own, or here.

Their requirements are not those of the project (numpy 1, opencv, …): `COPEM_KITS=/env/bin/python` names the Python of
an environment that has them. Tests skip where neither has the kit.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest


def ask_kit(module: str, code: str, *arguments: object) -> Any:
    """What `code` prints as JSON, run by a Python that has `module`, with `sys.argv[1:]` as `arguments`."""
    for python in (os.environ.get("COPEM_KITS", ""), sys.executable):
        if python and not subprocess.run([python, "-c", f"import {module}"], capture_output=True).returncode:
            words = [python, "-c", code, *map(str, arguments)]
            done = subprocess.run(words, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            return json.loads(done.stdout.splitlines()[-1])
    pytest.skip(f"{module} is not installed: COPEM_KITS names the Python of an environment that has it")
