"""Programs of controllers as software reads them that Planish did not write.

    python vendors.py TRAJECTORY MACHINE.json

* zaber: the Zaber Motion Library loads the sequence; every number and unit is that of the file.
* twincat: blark parses the program for the PLC, and refuses it with one word less.
"""

import pathlib
import subprocess
import sys
import tempfile

import zaber_motion
from blark.parse import parse_source_code
from zaber_motion.ascii import PvtSequence

ROOT = pathlib.Path(__file__).resolve().parents[3]


def zaber(program):
    rows = [[float(v) for v in line.split(",")] for line in program.read_text().splitlines()[1:]]
    points = PvtSequence.load_sequence_data(str(program)).sequence_data
    assert len(points) == len(rows) > 1
    units = zaber_motion.Units
    for row, point in zip(rows, points):
        found = [point.time, *(m for pair in zip(point.positions, point.velocities) for m in pair)]
        assert [m.value for m in found] == row and not point.relative
        assert found[0].unit == units.TIME_SECONDS
        assert {m.unit for m in found[1::2]} == {units.LENGTH_MILLIMETRES}
        assert {m.unit for m in found[2::2]} == {units.VELOCITY_MILLIMETRES_PER_SECOND}
    print(f"zaber: the library of the vendor reads {len(points)} points as they are written")


def twincat():
    source = (ROOT / "docs/twincat-table.st").read_text()

    def fails(text):
        return parse_source_code(text).exception is not None

    assert not fails(source)
    assert fails(source.replace("END_CASE", "", 1))
    print(f"twincat: blark parses the {len(source.splitlines())} lines of twincat-table.st")


if __name__ == "__main__":
    trajectory, machine = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        out = pathlib.Path(folder, "sequence.csv")
        command = [ROOT / "target/release/planish-export", "zaber", "--trajectory", trajectory, "--machine", machine,
                   "--out", out]
        subprocess.run(command, check=True, capture_output=True)
        zaber(out)
    twincat()
