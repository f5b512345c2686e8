//! Errors that a process adds to the residual of a plan.
//!
//! ```text
//! e = P (z - M) = e0 - sum_i eta_i f_i - n
//! ```
//!
//! z is the desired removal, M what is executed, P removes what is free (a piston, or a plane). To first order
//! every error that one number decides adds a field f_i, the derivative of the executed removal: one pair of
//! simulations with the error of opposite signs ([`planish_simulate::deviation`], `lines`). Errors of their own in
//! every piece of the motion, and fluctuations in time, add a Gaussian field n, whose covariance is known from the
//! removal of the pieces ([`noise`]). Then
//!
//! * what an error adds alone is the RMS of its field, and the part of it that the tool reaches (`lines`, [`reach`]);
//! * the residual's distribution comes from draws in as many dimensions as there are errors (`distribution`,
//!   [`draws`]).
//!
//! Whether the first order is enough is measured: every error is simulated once as it is, and a sample of runs
//! with all of them. Where an error of one number departs from its first order by more than
//! [`LARGEST_DEPARTURE_OF_LINE`], its line is that of simulated runs. Where an error departs by more than
//! [`LARGEST_DEPARTURE`], and not by less than [`SEEN`], so is the distribution (`resimulation`).
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | e0 | `nominal` | nm |
//! | f_i | `lines::Linear::field` | nm per size |
//! | eta_i | `sample::draw` | 1 |
//! | n | `noise::Columns::change` | nm |

// The command line names this library as any other program does.
extern crate self as planish_tolerance;

mod budget;
mod cli;
pub mod command;
mod distribution;
pub mod draws;
mod field;
pub mod inner;
mod lines;
pub mod noise;
pub mod quadratic;
pub mod reach;
mod report;
mod resimulation;
mod settings;
mod work;

// What a run with errors is stands where it is simulated: the virtual machine draws the same errors.
pub use planish_simulate::{deviation, error_budget, motion, sample, servo, tool};

pub use crate::{
    budget::{LARGEST_DEPARTURE, LARGEST_DEPARTURE_OF_LINE, SEEN, tolerance},
    report::{LEVELS, Pair, Tolerance},
    settings::{Free, ToleranceSettings},
};
