//! Helpers of the tests of several crates. The stages have this crate as a dev-dependency; its library
//! names none of them. The tests that see several crates are in `tests/`:
//!
//! * `architecture`: who may name whom, and what a library must not do.
//! * `conventions`: every statement of `docs/conventions.md`.
//! * `schedulers`: random paths through every scheduler, judged by `planish-verify`.
//! * `programs`: random motions exported to every controller and read back.
//! * `end_to_end`: a fixture through all binaries.
//! * `pipelines`: `just run` as a user calls it (`just test-pipelines`).
//! * `commands_as_printed`: the commands of README.md and docs/ (`just test-commands`).
//! * `random_problems`: programs, libraries and a sum of its own on random problems.
//! * `reference`: the reference mirror, where `PLANISH_REFERENCE` names its folder.
//!
//! `examples/reproduce` computes the claims of the papers (docs/reproduction.md).

pub mod hostile;
pub mod maps;
pub mod mirror;
pub mod program;
pub mod skipped;

use std::path::{Path, PathBuf};

use planish_pipeline::{
    definition::{Definition, SHARED},
    scope::Scope,
};
use planish_types::{Limits, MachineFile, MachineFileAxis};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// The folder of the workspace.
pub fn workspace() -> PathBuf {
    let crates = Path::new(env!("CARGO_MANIFEST_DIR")).parent();
    crates.and_then(Path::parent).expect("this crate is in crates/").to_path_buf()
}

/// Default of a setting of a pipeline.
pub fn pipeline_setting(pipeline: &str, name: &str) -> String {
    let text = |file: &str| {
        let file = workspace().join("pipelines").join(format!("{file}.yaml"));
        std::fs::read_to_string(file).expect("a pipeline")
    };
    let definition =
        Definition::read(pipeline, &text(SHARED), &text(pipeline)).expect("a definition");
    let scope = Scope::new::<&str>(&definition, &[]).expect("no settings");
    scope.text(name).expect("a setting of the pipeline")
}

/// Numbers in 0..1 from a seed, by Knuth's linear congruence. A golden value of a test belongs to them, so
/// they must never change.
pub fn numbers(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as f64 / 2f64.powi(31)
    }
}

/// A machine from the limits of (x, y), without a limit on jerk.
pub fn machine(velocity_mm_per_s: [f64; 2], acceleration_mm_per_s2: [f64; 2]) -> Limits {
    let axis = |a: usize| MachineFileAxis {
        name: ["x", "y"][a].into(),
        max_velocity_mm_per_s: velocity_mm_per_s[a],
        max_acceleration_mm_per_s2: acceleration_mm_per_s2[a],
        max_jerk_mm_per_s3: None,
        ..MachineFileAxis::default()
    };
    MachineFile {
        name: "test".into(),
        axes: vec![axis(0), axis(1)],
        min_segment_s: 0.0,
        ..MachineFile::default()
    }
    .checked()
    .unwrap()
}

/// The ion beam machine of the reference mirror.
pub fn ion_beam() -> Limits {
    machine([250.0, 150.0], [2000.0, 1000.0])
}

/// The generator of random case `index` of a population with the number `stream`; the same case
/// for the same seed, whatever the number of cases.
pub fn case_generator(seed: u64, stream: u64, index: u64) -> ChaCha8Rng {
    let mut generator = ChaCha8Rng::seed_from_u64(seed);
    generator.set_stream((stream << 32) | index);
    generator
}
