"""Refuses crates whose licence or origin deny.toml does not allow: licences.py [TARGET]

It checks the crates that are compiled into the programs, for TARGET or for this machine, and needs no network and no
cargo-deny. It does not check for known vulnerabilities: `just deny` does. It needs Python 3.11 or later.
"""

import re
import sys
import tomllib

from notices import ROOT, resolved

CRATES_IO = "registry+https://github.com/rust-lang/crates.io-index"


def satisfied(expression, allowed):
    """True if licences of the list satisfy an SPDX expression. AND binds stronger than OR; WITH belongs to its licence."""
    words = re.findall(r"[()]|[\w.+-]+(?: WITH [\w.+-]+)?", expression.replace("/", " OR "))

    def one():
        word = words.pop(0)
        if word != "(":
            return word in allowed
        inner = either()
        words.pop(0)
        return inner

    def both():
        value = one()
        while words and words[0] == "AND":
            words.pop(0)
            value = one() and value
        return value

    def either():
        value = both()
        while words and words[0] == "OR":
            words.pop(0)
            value = both() or value
        return value

    return either()


def main():
    allowed = tomllib.loads((ROOT / "deny.toml").read_text("utf-8"))["licenses"]["allow"]
    wrong = []
    crates = [package for package, _ in resolved(*sys.argv[1:]).values()]
    for package in crates:
        name = f"{package['name']} {package['version']}"
        if not satisfied(package["license"] or "none", allowed):
            wrong.append(f"{name}: its licence is {package['license']}; deny.toml allows {', '.join(allowed)}")
        if package["source"] not in (None, CRATES_IO):
            wrong.append(f"{name}: comes from {package['source']}; take it from crates.io")
    for line in wrong:
        print(f"error: {line}", file=sys.stderr)
    if not wrong:
        print(f"licences: deny.toml allows those of all {len(crates)} crates in the programs")
    return 1 if wrong else 0


if __name__ == "__main__":
    # The evaluation itself, on the forms that occur
    assert satisfied("MIT/Apache-2.0", ["MIT"]) and not satisfied("MIT AND Zlib", ["MIT"])
    assert satisfied("(MIT OR GPL-3.0-only) AND Zlib", ["MIT", "Zlib"]) and not satisfied("A OR B AND C", ["B"])
    assert not satisfied("Apache-2.0 WITH LLVM-exception", ["Apache-2.0"])
    sys.exit(main())
