//! Motions of axes in time, as polynomial pieces of degree three at most.

pub mod clothoid;
pub mod state_to_state;
pub mod timing_law;
