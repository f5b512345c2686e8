//! Schedulers to compare with: a published motion as it was printed, and two idealised motions that no machine can
//! execute. Reports show them, but recommend none.

pub mod average_velocity;
pub mod position;
pub mod pvt_as_published;
