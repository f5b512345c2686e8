//! Solvers to compare with the literature. A report shows their plans, and recommends none.

pub mod bcls;
pub mod feed_law;
pub mod non_negative_least_squares;
pub mod truncated_svd;
