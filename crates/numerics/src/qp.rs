//! Quadratic programs: a convex quadratic function within bounds.
//!
//! | module | constraints | method |
//! |---|---|---|
//! | [`bounded`] | lower and upper bounds | primal-dual active set, projected gradient |
//! | [`nnls`] | non-negativity of dense least squares | active set of Lawson and Hanson |
//! | [`chain`] | each between two neighbours of a chain | interior point |

pub mod bounded;
pub mod chain;
pub mod nnls;
