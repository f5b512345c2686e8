//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "frozen.rs"]
mod frozen;
#[path = "reading.rs"]
mod reading;
mod support;
#[path = "writing.rs"]
mod writing;
