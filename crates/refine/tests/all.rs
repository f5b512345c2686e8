//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "closed_loop.rs"]
mod closed_loop;
#[path = "process.rs"]
mod process;
