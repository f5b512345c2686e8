"""What goes into the wheel beside the Python module: the programs without their symbols, and the pipelines as data.

Called by hatchling (`just wheel`), after build_programs.sh and notices.py. The programs become scripts of the environment;
pipelines, fixtures and machines stand in `planish/share`, where `planish run` reads them. The licence and those of the
crates stand beside the metadata.
"""

import os
import pathlib
import subprocess
import sysconfig

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROGRAMS = ROOT / "target/wheel/build/release"
NOTICES = ROOT / "target/wheel/THIRD-PARTY-NOTICES.txt"
# For the checks of the programs, and nobody's plan.
LEFT_OUT = {"planish-fuzz"}


class Programs(BuildHookInterface):
    def initialize(self, version, build_data):
        stripped = ROOT / "target/wheel/programs"
        stripped.mkdir(parents=True, exist_ok=True)
        programs = [p for p in sorted(PROGRAMS.glob("planish-*")) if not p.suffix and p.name not in LEFT_OUT]
        if not programs:
            raise SystemExit(f"{PROGRAMS}: there are no programs; run just wheel")
        for program in programs:
            subprocess.run(["strip", "-o", stripped / program.name, program], check=True)
            self.refuse_paths(stripped / program.name)
            build_data["shared_scripts"][str(stripped / program.name)] = program.name
        for folder, pattern in (
            ("pipelines", "*.just"),
            ("pipelines", "start.sh"),
            ("pipelines", "show.awk"),
            ("fixtures", "*.json"),
            ("fixtures/machines", "*.json"),
            ("fixtures/error-budgets", "*.json"),
            ("fixtures/specifications", "*.json"),
        ):
            for file in sorted((ROOT / folder).glob(pattern)):
                build_data["force_include"][str(file)] = f"planish/share/{folder}/{file.name}"
        for file in (ROOT / "python/matlab/planish.m", ROOT / "docs/notebook.ipynb"):
            build_data["force_include"][str(file)] = f"planish/share/{file.name}"
        licences = f"{self.metadata.name}-{self.metadata.version}.dist-info/licenses"
        for file in (ROOT / "LICENSE", NOTICES):
            build_data["force_include"][str(file)] = f"{licences}/{file.name}"
        build_data["pure_python"] = False
        # Of the C library that it was linked with: this wheel is for machines like this one.
        build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"

    def refuse_paths(self, program):
        """Refuses a program that names the folders that it was built in."""
        content = program.read_bytes()
        for folder in (ROOT, os.environ.get("CARGO_HOME") or pathlib.Path.home() / ".cargo"):
            if f"{folder}/".encode() in content:
                raise SystemExit(f"{program}: names {folder}; build it by python/build_programs.sh")
