//! `planish STAGE ARGUMENTS...`: every stage of Planish in one program.

mod stages;

use std::process::ExitCode;

use planish_handoff::Allocator;

#[global_allocator]
static ALLOCATOR: Allocator = Allocator;

fn main() -> ExitCode {
    planish_handoff::start(&stages::STAGES)
}
