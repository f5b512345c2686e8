//! Systems of linear equations and least squares without bounds.

pub mod lanczos;
pub mod lsqr;
pub mod skyline;
