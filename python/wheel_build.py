"""What goes into the wheel beside the Python module: the programs, and the pipelines as data.

Called by hatchling (`just wheel`, `just wheels`), after build_programs.sh, notices.py and sbom.py. One file holds all
stages (crates/planish), and a script per name calls it: what the programs share is there once. Both become scripts of
the environment. Pipelines, fixtures and machines stand in `planish/share`, where `planish run` reads them. The licence,
those of the crates, and the bill of materials stand beside the metadata.

PLANISH_PROGRAMS_FILE names the file with all programs, and PLANISH_WHEEL_TAG the systems that it runs on.
"""

import os
import pathlib
import re
import subprocess
import sys
import sysconfig

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

ROOT = pathlib.Path(__file__).resolve().parent.parent
WHEEL = ROOT / "target/wheel"
ALL = "planish_programs"
# A symbolic link to a script is followed to the script, beside which the file with all programs is.
CALL = """#!/bin/sh
case $0 in */*) file=$0 ;; *) file=./$0 ;; esac
[ ! -L "$file" ] || file=$(readlink -f "$file")
exec "${file%/*}/ALL" NAME "$@"
"""


def names():
    """Names of all programs: those of the crates with a `command.rs`."""
    manifests = [main.parents[1] / "Cargo.toml" for main in sorted(ROOT.glob("crates/*/src/command.rs"))]
    return [re.search(r'^name = "(.*)"', manifest.read_text("utf-8"), re.MULTILINE)[1] for manifest in manifests]


class Programs(BuildHookInterface):
    def initialize(self, version, build_data):
        program = pathlib.Path(os.environ.get("PLANISH_PROGRAMS_FILE") or WHEEL / "build/release/planish")
        if not program.is_file():
            raise SystemExit(f"{program}: there are no programs; run just wheel")
        self.refuse_paths(program)
        build_data["shared_scripts"][str(program)] = ALL
        scripts = WHEEL / "scripts"
        scripts.mkdir(parents=True, exist_ok=True)
        for name in names():
            (scripts / name).write_text(CALL.replace("ALL", ALL).replace("NAME", name), "utf-8")
            (scripts / name).chmod(0o755)
            build_data["shared_scripts"][str(scripts / name)] = name
        for folder, pattern in (
            ("pipelines", "*.yaml"),
            ("fixtures", "*.json"),
            ("fixtures", "*.tool"),
            ("fixtures/machines", "*.json"),
            ("fixtures/error-budgets", "*.json"),
            ("fixtures/specifications", "*.json"),
        ):
            for file in sorted((ROOT / folder).glob(pattern)):
                build_data["force_include"][str(file)] = f"planish/share/{folder}/{file.name}"
        for file in (ROOT / "python/matlab/planish.m", ROOT / "docs/notebook.ipynb"):
            build_data["force_include"][str(file)] = f"planish/share/{file.name}"
        build_data["force_include"][str(self.types(program))] = "planish/_stages.pyi"
        about = f"{self.metadata.name}-{self.metadata.version}.dist-info"
        for file in (ROOT / "LICENSE", WHEEL / "THIRD-PARTY-NOTICES.txt"):
            build_data["force_include"][str(file)] = f"{about}/licenses/{file.name}"
        build_data["force_include"][str(WHEEL / "planish.cdx.json")] = f"{about}/sboms/planish.cdx.json"
        build_data["pure_python"] = False
        # Without a tag, of the C library that it was linked with: this wheel is for machines like this one.
        tag = os.environ.get("PLANISH_WHEEL_TAG") or re.sub(r"[-.]", "_", sysconfig.get_platform())
        build_data["tag"] = f"py3-none-{tag}"

    def types(self, program):
        """Returns the file with the types of the stage functions. A program for another machine does not run here: then the
        file is that of the wheel before."""
        file = WHEEL / "_stages.pyi"
        made = subprocess.run([sys.executable, ROOT / "python/stubs.py", program], capture_output=True, text=True)
        if made.returncode == 0:
            file.write_text(made.stdout, "utf-8")
        elif not file.is_file():
            raise SystemExit(f"{program}: does not run here; make the wheel for this machine first\n{made.stderr}")
        return file

    def refuse_paths(self, program):
        """Refuses a program that names the folders that it was built in."""
        content = program.read_bytes()
        for folder in (ROOT, os.environ.get("CARGO_HOME") or pathlib.Path.home() / ".cargo"):
            if f"{folder}/".encode() in content:
                raise SystemExit(f"{program}: names {folder}; build it by python/build_programs.sh")
