//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

mod example;
#[path = "oracles.rs"]
mod oracles;
#[path = "quadratic.rs"]
mod quadratic;
#[path = "varying.rs"]
mod varying;
