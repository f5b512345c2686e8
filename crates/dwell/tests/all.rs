//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

mod definition;
#[path = "oracles.rs"]
mod oracles;
#[path = "path_free_bound.rs"]
mod path_free_bound;
#[path = "random_problems.rs"]
mod random_problems;
#[path = "reference.rs"]
mod reference;
#[path = "several_tools.rs"]
mod several_tools;
#[path = "solvers.rs"]
mod solvers;
