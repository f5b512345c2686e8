//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "near_path.rs"]
mod near_path;
