"""Bill of materials of the programs as CycloneDX 1.5 in JSON: sbom.py [TARGET] > planish.cdx.json

It lists every crate that is compiled into the programs for TARGET (without one: for this machine), with its version,
licence, origin and SHA-256, and which crate names which. Crates that only tests or build scripts need are left out.
"""

import json
import sys
import tomllib

from notices import ROOT, resolved


def component(identifier, package, sha256):
    """A crate as CycloneDX describes a library."""
    about = {
        "type": "library",
        "bom-ref": identifier,
        "name": package["name"],
        "version": package["version"],
    }
    if package["source"]:
        about["purl"] = f"pkg:cargo/{package['name']}@{package['version']}"
    if package["license"]:
        # Cargo still takes the older "/" between two licences.
        about["licenses"] = [{"expression": package["license"].replace("/", " OR ")}]
    if sha256:
        about["hashes"] = [{"alg": "SHA-256", "content": sha256}]
    if package["repository"]:
        about["externalReferences"] = [{"type": "vcs", "url": package["repository"]}]
    return about


def main():
    sys.stdout.reconfigure(encoding="utf-8")
    locked = tomllib.loads((ROOT / "Cargo.lock").read_text("utf-8"))["package"]
    sha256 = {(p["name"], p["version"]): p.get("checksum") for p in locked}
    crates = resolved(*sys.argv[1:])
    # Identifiers of Cargo name the folder of a crate of this repository.
    refs = {key: f"{p['name']}@{p['version']}" for key, (p, _) in crates.items()}
    (root,) = [key for key, (p, _) in crates.items() if p["name"] == "planish"]
    components = [
        component(refs[key], p, sha256.get((p["name"], p["version"]))) for key, (p, _) in crates.items() if key != root
    ]
    version = crates[root][0]["version"]
    planish = {
        "type": "application",
        "bom-ref": refs[root],
        "name": "planish",
        "version": version,
        "purl": f"pkg:pypi/planish@{version}",
        "licenses": [{"expression": crates[root][0]["license"]}],
    }
    bill = {
        "$schema": "http://cyclonedx.org/schema/bom-1.5.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": planish},
        "components": components,
        "dependencies": [{"ref": refs[key], "dependsOn": [refs[u] for u in uses]} for key, (_, uses) in crates.items()],
    }
    print(json.dumps(bill, indent=1))


if __name__ == "__main__":
    main()
