//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "axes.rs"]
mod axes;
mod example;
#[path = "plan.rs"]
mod plan;
