//! Several runs on one mirror: the decision to run again, and the results of a campaign on the virtual machine.
//!
//! * [`decision`]: run again or stop, from the map after a run and the expected residual of the next plan.
//! * [`summary`]: residuals with learning, without learning and with a known tool, run by run, and the learnt
//!   parameters beside the hidden truth; [`page`] shows it.

// The command line names this library as any other program does.
extern crate self as planish_campaign;

mod cli;
pub mod command;
pub mod decision;
pub mod page;
pub mod summary;
