//! Motions of axes in time, as cubic pieces.

pub mod clothoid;
pub mod state_to_state;
pub mod timing_law;
