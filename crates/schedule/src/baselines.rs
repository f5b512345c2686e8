//! Schedulers to compare with: the motion of a publication as it was printed, and the two ideas of dwell times that no
//! machine can execute. A report shows them, and recommends none.

pub mod average_velocity;
pub mod position;
pub mod pvt_as_published;
