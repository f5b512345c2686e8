//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "limits.rs"]
mod limits;
#[path = "programs.rs"]
mod programs;
#[path = "tool.rs"]
mod tool;
