//! Artifacts that version 0.1.0 wrote are read by every later version: fixtures/frozen, which never changes.
//!
//! Directories of pages, pictures and tables (`report`, `figures`, `campaign`, `sweep`) hold what programs read of them,
//! which is the manifest. `docs/stability.md` promises what is checked here.

use std::path::PathBuf;

use planish_handoff::{
    Arrays, Artifact, Inputs, artifact,
    kind::{self, Kind},
    npy::ArrayData,
};
use planish_types::Invalid;

fn frozen() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/frozen/0.1.0")
}

/// Reads the frozen artifact of a kind, with all its arrays, and returns its manifest.
macro_rules! read {
    ($($kind:ident),*) => {
        [$({
            struct Any;
            impl Artifact for Any {
                const KIND: &'static Kind = &kind::$kind;
                fn to_arrays(&self) -> Vec<ArrayData<'_>> {
                    unreachable!("nothing is written")
                }
                fn from_arrays(_: Arrays) -> Result<Self, Invalid> {
                    Ok(Self)
                }
            }
            let dir = frozen().join(kind::$kind.name);
            // Dtypes, shapes, finiteness and hashes are checked here, and the seal of the manifest.
            let loaded = artifact::read::<Any>(&dir).unwrap_or_else(|e| panic!("{e}"));
            assert_eq!(loaded.warning, None, "{}", dir.display());
            (&kind::$kind, loaded.manifest.expect("a frozen artifact has a manifest"))
        }),*]
    };
}

#[test]
fn every_kind_of_0_1_0_is_read() {
    let read = read![
        SURFACE,
        TIF,
        TOOL,
        TOOL_PATH,
        DWELL,
        DWELL_DENSITY,
        TRAJECTORY,
        TRANSFORM,
        AXES,
        REMOVAL,
        FRAMES,
        ITERATIONS,
        VERDICT,
        BOUND,
        TOLERANCE,
        RECONCILIATION,
        DECISION,
        CAMPAIGN,
        PSD,
        SPECIFICATION,
        REPORT,
        FIGURES,
        SWEEP
    ];
    for (kind, manifest) in &read {
        assert_eq!(manifest.kind, kind.name);
        assert_eq!(manifest.tool_version, "0.1.0", "{}", kind.name);
        // The whole layout is in the file: an artifact of a version that lacked optional arrays lists fewer.
        assert!(manifest.version <= kind.version, "{}", kind.name);
    }
    let names: Vec<_> = read.iter().map(|(kind, _)| kind.name).collect();
    for kind in kind::ALL {
        assert!(
            names.contains(&kind.name),
            "{} has no frozen artifact; see docs/stability.md",
            kind.name
        );
    }
}

#[test]
fn the_machine_file_of_0_1_0_is_read() {
    let machine = Inputs::new().read_machine(&frozen().join("machine.json")).unwrap();
    assert_eq!(machine.limits().axes()[0].max_velocity_mm_per_s(), 100.0);
}
