//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "controller.rs"]
mod controller;
mod example;
mod known;
#[path = "known_truth.rs"]
mod known_truth;
#[path = "next_run.rs"]
mod next_run;
#[path = "oracles.rs"]
mod oracles;
#[path = "varying.rs"]
mod varying;
