//! Every program of Planish in one file, as the wheel has it: `planish_programs planish-dwell ARGUMENTS...` is
//! `planish-dwell ARGUMENTS...`. Each program is its own `main.rs`, as a module.

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: planish_handoff::Allocator = planish_handoff::Allocator;

#[path = "../../../crates/axes/src/main.rs"]
mod axes;
#[path = "../../../crates/bspline-feed/src/main.rs"]
mod bspline_feed;
#[path = "../../../crates/campaign/src/main.rs"]
mod campaign;
#[path = "../../../crates/compare/src/main.rs"]
mod compare;
#[path = "../../../crates/dwell/src/main.rs"]
mod dwell;
#[path = "../../../crates/export/src/main.rs"]
mod export;
#[path = "../../../crates/fixture/src/main.rs"]
mod fixture;
#[path = "../../../crates/import/src/main.rs"]
mod import;
#[path = "../../../crates/joint/src/main.rs"]
mod joint;
#[path = "../../../crates/reconcile/src/main.rs"]
mod reconcile;
#[path = "../../../crates/refine/src/main.rs"]
mod refine;
#[path = "../../../crates/register/src/main.rs"]
mod register;
#[path = "../../../crates/run/src/main.rs"]
mod run;
#[path = "../../../crates/schedule/src/main.rs"]
mod schedule;
#[path = "../../../crates/simulate/src/main.rs"]
mod simulate;
#[path = "../../../crates/surface/src/main.rs"]
mod surface;
#[path = "../../../crates/sweep/src/main.rs"]
mod sweep;
#[path = "../../../crates/tolerance/src/main.rs"]
mod tolerance;
#[path = "../../../crates/toolpath/src/main.rs"]
mod toolpath;
#[path = "../../../crates/verify/src/main.rs"]
mod verify;

fn main() -> ExitCode {
    planish_handoff::together(&[
        ("planish-axes", axes::main),
        ("planish-bspline-feed", bspline_feed::main),
        ("planish-campaign", campaign::main),
        ("planish-compare", compare::main),
        ("planish-dwell", dwell::main),
        ("planish-export", export::main),
        ("planish-fixture", fixture::main),
        ("planish-import", import::main),
        ("planish-joint", joint::main),
        ("planish-reconcile", reconcile::main),
        ("planish-refine", refine::main),
        ("planish-register", register::main),
        ("planish-run", run::main),
        ("planish-schedule", schedule::main),
        ("planish-simulate", simulate::main),
        ("planish-surface", surface::main),
        ("planish-sweep", sweep::main),
        ("planish-tolerance", tolerance::main),
        ("planish-toolpath", toolpath::main),
        ("planish-verify", verify::main),
    ])
}
