"""Licences of everything that is compiled into the programs: notices.py [TARGET] > THIRD-PARTY-NOTICES.txt

Reads what Cargo knows of the locked crates for TARGET (without one: for this machine), and the licence files that each of
them has. Crates that only tests or build scripts need are left out; so are those of this repository.
"""

import json
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
LICENCE_FILE = re.compile(r"^(licen[cs]e|copying|copyright|notice|unlicense)", re.IGNORECASE)
RULE = "=" * 100


def resolved(target=None):
    """The crates in the programs with the identifiers of those that each names, those of this repository among them."""
    if target is None:
        target = re.search(r"^host: (.*)$", subprocess.check_output(["rustc", "-vV"], text=True), re.MULTILINE)[1]
    command = ["cargo", "metadata", "--locked", "--format-version", "1", "--filter-platform", target]
    metadata = json.loads(subprocess.check_output(command, cwd=ROOT))
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    by_id = {package["id"]: package for package in metadata["packages"]}
    # The crate that has all programs
    wanted, found = [key for key, package in by_id.items() if package["name"] == "planish"], {}
    while wanted:
        crate = wanted.pop()
        if crate not in found:
            # A dependency without a kind is one of the library or the program.
            uses = [d["pkg"] for d in nodes[crate]["deps"] if any(k["kind"] is None for k in d["dep_kinds"])]
            found[crate] = by_id[crate], sorted(uses)
            wanted += uses
    return dict(sorted(found.items(), key=lambda item: (item[1][0]["name"], item[1][0]["version"])))


def texts(package):
    """The licence files of a crate: names and texts."""
    folder = pathlib.Path(package["manifest_path"]).parent
    files = [file for file in sorted(folder.rglob("*")) if LICENCE_FILE.match(file.name) and file.is_file()]
    # Sources of such a name are none.
    files = [file for file in files if file.suffix in ("", ".txt", ".md", ".rst") or file.suffix[1:].isupper()]
    return [(str(file.relative_to(folder)), file.read_text("utf-8", "replace").strip()) for file in files]


def main():
    sys.stdout.reconfigure(encoding="utf-8")
    print("The programs of Planish contain code of the Rust standard library (MIT OR Apache-2.0,")
    print("https://github.com/rust-lang/rust) and of these crates, each under the licence named with it.")
    first_with = {}
    for package in [p for p, _ in resolved(*sys.argv[1:]).values() if p["source"]]:
        name = f"{package['name']} {package['version']}"
        licence = package["license"] or f"see {package['license_file']}"
        print(f"\n{RULE}\n{name}\nLicence: {licence}")
        for line in (", ".join(package["authors"] or []), package["repository"] or package["homepage"] or ""):
            if line:
                print(line)
        found = texts(package)
        if not found:
            print("The crate has no file with its licence.")
        for file, text in found:
            # The same text stands here once.
            other = first_with.setdefault(text, f"{file} of {name}")
            print(f"\n--- {file}" + (f": the same as {other}" if other != f"{file} of {name}" else f"\n\n{text}"))


if __name__ == "__main__":
    main()
