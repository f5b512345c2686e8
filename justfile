# Planish. `just --list` shows the recipes; every pipeline is a file in pipelines/.

[private]
default:
    @just --list

# Run a pipeline: just run raster pitch_mm=0.5 surface=DIR tif=DIR machine=FILE out=DIR
run name *overrides: build
    @just --justfile pipelines/{{ name }}.just --working-directory . {{ overrides }} run

# Show a pipeline with its settings and their defaults
show name:
    @cat pipelines/{{ name }}.just pipelines/stages.just

# Build the stages
build:
    @cargo build --quiet --release --locked --workspace --bins

# Make every fixture mirror under out/fixtures
fixtures: build
    @for recipe in fixtures/*.json; do \
        target/release/planish-fixture "$recipe" --force \
            --out "out/fixtures/$(basename "$recipe" .json)" || exit; \
    done

# Run the tests; with PLANISH_REFERENCE set, also those on the reference mirror
test:
    cargo test --locked --workspace

# Everything that must pass before a change lands
ci: test
    cargo fmt --all --check
    cargo clippy --locked --workspace --all-targets -- -D warnings
    RUSTDOCFLAGS="-D warnings" cargo doc --locked --workspace --no-deps --quiet
    just docs
    git diff --exit-code docs
    just run raster fixture=coupon out=out/ci
    just run maze fixture=coupon refine=no out=out/ci-maze
    just python-example

# Residual against total time along a raster: prints the table, draws out/pareto/FIXTURE/curve/pareto.svg
pareto fixture="flat-92x16" machine="fixtures/machines/ion-beam.json" min_dwell_s_per_mm="0.02": build
    @target/release/planish-fixture fixtures/{{ fixture }}.json --out out/pareto/{{ fixture }} --force
    @target/release/planish-toolpath raster --surface out/pareto/{{ fixture }}/surface --tif out/pareto/{{ fixture }}/tif --pitch-mm 1 --step-mm 1 --out out/pareto/{{ fixture }}/tool_path --force
    @target/release/planish-pareto --surface out/pareto/{{ fixture }}/surface --tif out/pareto/{{ fixture }}/tif --tool-path out/pareto/{{ fixture }}/tool_path --machine {{ machine }} --min-dwell-s-per-mm {{ min_dwell_s_per_mm }} --out out/pareto/{{ fixture }}/curve --force

# Write the generated pages and pictures in docs/
docs: (picture "raster" "raster" "coupon" "--pitch-mm 1 --step-mm 1 --turn semicircle") (picture "maze" "maze" "coupon" "--pitch-mm 1") (picture "maze-disk" "maze" "disk-100" "--pitch-mm 3 --overscan-mm 3 --corner-radius-mm 1.5 --step-mm 0.5 --seed 2") (picture "multi-pitch" "multi-pitch" "square-200" "--max-velocity-mm-per-s 3 --classes 4 --step-mm 4 --overscan-mm 7") (picture "spiral" "spiral" "disk-100" "--pitch-mm 3 --overscan-mm 3 --step-mm 1")
    @cargo run --quiet --locked -p planish-handoff --example formats > docs/formats.md

# Draw a path over a fixture to docs/paths/NAME.svg
picture name method fixture flags: build
    @mkdir -p docs/paths
    @target/release/planish-fixture fixtures/{{ fixture }}.json --out out/pictures/{{ fixture }} --force
    @target/release/planish-toolpath {{ method }} --surface out/pictures/{{ fixture }}/surface --tif out/pictures/{{ fixture }}/tif {{ flags }} --out out/pictures/{{ name }} --force
    @target/release/planish-toolpath draw --tool-path out/pictures/{{ name }} --surface out/pictures/{{ fixture }}/surface --out docs/paths/{{ name }}.svg --force

# Run docs/replace_a_stage.py in the place of the dwell solver (makes its own virtual environment)
python-example: build
    @test -d target/python || python3 -m venv target/python
    @target/python/bin/pip install --quiet numpy
    just run raster fixture=coupon out=out/python
    target/python/bin/python docs/replace_a_stage.py out/python out/python-dwell
    target/release/planish-schedule pvt --tool-path out/python/tool_path --dwell out/python-dwell \
        --machine fixtures/machines/ion-beam.json --out out/python-trajectory --force

# Run the benchmarks
bench:
    cargo bench --locked -p planish-testkit --bench stages
