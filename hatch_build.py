"""Build hook: the interpreters of programs, compiled into the wheel.

Where there is no compiler that knows vectors, and where ROBINS_PURE is set, the wheel is one of
Python alone: it compiles the interpreter when it is first used, or computes by JAX.
"""

from __future__ import annotations

import os
import runpy
import shlex
import shutil
import subprocess
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

COMPILERS = ("c++", "g++", "clang++")


class Interpreters(BuildHookInterface):
    """Compiles the interpreters of `robins.program`."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the libraries to a wheel that is not editable, and name its platform."""
        if self.target_name != "wheel" or version == "editable" or os.environ.get("ROBINS_PURE"):
            return
        found = shlex.split(os.environ.get("CXX", "")) or list(filter(shutil.which, COMPILERS))[:1]
        if not found:
            self.app.display_warning("no C++ compiler: the wheel has no interpreter of programs")
            return
        room = runpy.run_path(str(Path(self.root) / "src/robins/program/flags.py"))
        self._folder = tempfile.TemporaryDirectory(prefix="robins-interpreters-")
        try:
            made = room["compile_interpreters"](found, Path(self._folder.name))
        except (OSError, subprocess.CalledProcessError) as error:
            said = getattr(error, "stderr", None) or error
            self.app.display_warning(f"the wheel has no interpreter of programs: {said}")
            return
        for library in made:
            build_data["force_include"][str(library)] = f"robins/program/built/{library.name}"
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["pure_python"], build_data["tag"] = False, f"py3-none-{platform}"
