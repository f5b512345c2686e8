"""The few inputs that together reach most of a reader: `least.py CONTROL CORPUS`.

CONTROL is what libFuzzer writes when it merges: the names of the inputs, then for each what it reaches. The
chosen ones, greedily, replace the files in CORPUS.
"""

import hashlib
import sys
from pathlib import Path

MOST_INPUTS = 12
# What a datx or HDF5 file needs for its header alone; other formats get along with a few hundred bytes.
LARGEST_BYTES = 14_000

control, corpus = Path(sys.argv[1]), Path(sys.argv[2])
lines = control.read_text().splitlines()
count = int(lines[0])
names = [Path(line) for line in lines[2:2 + count]]
reached = {}
for line in lines[2 + count:]:
    words = line.split()
    if words and words[0] == "FT":
        reached[int(words[1])] = set(words[2:])
contents = {i: names[i].read_bytes() for i in reached}
contents = {i: data for i, data in contents.items() if len(data) <= LARGEST_BYTES}
everything = set().union(*reached.values())
chosen, covered = [], set()
while len(chosen) < MOST_INPUTS:
    # Of those that add as much, the smallest, then the first by content: the same choice on every run.
    best = min(contents, key=lambda i: (-len(reached[i] - covered), len(contents[i]), contents[i]))
    if not reached[best] - covered:
        break
    chosen.append(best)
    covered |= reached[best]
for file in corpus.iterdir():
    file.unlink()
for i in chosen:
    (corpus / hashlib.sha256(contents[i]).hexdigest()[:16]).write_bytes(contents[i])
size = sum(len(contents[i]) for i in chosen)
print(f"{corpus.name}: {len(chosen)} of {count} inputs, {size} bytes, {len(covered)} of {len(everything)} edges")
