//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "chain.rs"]
mod chain;
