//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "hostile.rs"]
mod hostile;
#[path = "oracles.rs"]
mod oracles;
#[path = "quadratic.rs"]
mod quadratic;
#[path = "varying.rs"]
mod varying;
