//! Reconciliation of a run: the true rate, place, width and shape of the tool from the maps before and after it.
//!
//! ```text
//! d = before - after = (1 + a) M(s, theta, m, w, e) + Q c + n                                 (1)
//! ```
//!
//! M is the removal of the executed motion with its deviations (`planish_simulate::runs`, the model by which
//! `planish tolerance` judges a plan and the virtual machine runs it), Q the low-order terms that an interferometer
//! does not measure (piston, tilt, power; more where asked for), n noise of any correlation. Least squares over the
//! pixels that are valid in both maps, by Gauss and Newton's steps, give all unknowns together ([`fit`]).
//!
//! * **Standard errors** do not count pixels: the rest of the fit is correlated, and its autocovariance goes into the
//!   covariance of the estimate ([`correlation`]).
//! * **A number is given where the data determine it.** Otherwise the parameter is refused by name, with the reason
//!   ([`determined`]): it cannot be told from other terms, its standard error is beyond what anybody would believe
//!   beforehand, or it depends on terms of the metrology that were taken as known.
//!
//! Source of the covariance: H. White, Econometrica 48 (1980) 817; W. Newey, K. West, Econometrica 55 (1987) 703; of
//! the window: N. Madras, A. Sokal, J. Stat. Phys. 50 (1988) 109; of the comparison of two fits: J. Hausman,
//! Econometrica 46 (1978) 1251.
//!
//! | symbol | variable | shape | unit |
//! |---|---|---|---|
//! | d | `data` | (ny, nx) | nm |
//! | M | `planish_simulate::runs::Runs::removal_nm` | (ny, nx) | nm |
//! | a, s, theta, m, w, e | `parameter::Parameter` | | 1, mm, rad |
//! | Q | `metrology::Term` | (ny, nx) | 1 |
//! | c | | | nm |

// The command line names this library as any other program does.
extern crate self as planish_reconcile;

pub mod applied;
pub mod bands;
mod cli;
pub mod command;
mod contradictory;
pub mod controller;
pub mod correlation;
pub mod determined;
pub mod draw;
pub mod fit;
mod left;
pub mod metrology;
pub mod model;
pub mod parameter;
mod place;
mod reconcile;
pub mod resample;
mod settings;

pub use crate::{
    reconcile::{Comparison, Reconciled, reconcile},
    settings::ReconcileSettings,
};
