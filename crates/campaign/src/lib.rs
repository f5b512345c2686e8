//! Runs in a row: whether the next one is worth it, and what a campaign on the virtual machine showed.
//!
//! * [`decision`]: run again or stop, from the map after a run and what the next plan is expected to leave.
//! * [`summary`]: a campaign with and without learning beside one of a known tool, run by run, and the parameters that
//!   were learnt beside the hidden truth; [`page`] shows it.

pub mod decision;
pub mod page;
pub mod summary;
