#!/usr/bin/env bash
# Runs, scores, and compares the settings of one problem: benchmark/test.sh PROBLEM DIR
set -euo pipefail
cd "$(dirname "$0")/.."
python3 benchmark/measured.py "$PLANISH_REFERENCE"
python3 benchmark/run.py "$1" --out "$2"
for table in errors defaults; do
    python3 benchmark/run.py "$1" --out "$2" --$table > "$2/$table.txt"
    test -s "$2/$table.txt"
    cat "$2/$table.txt"
done
