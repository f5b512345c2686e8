//! Mathematics without optics, shared by the stages.
//!
//! Nothing here knows a unit, a file or a clock. A routine is in this crate if two crates need it,
//! or if it is a textbook method that would hide the algorithm that uses it.
//!
//! | module | contents |
//! |---|---|
//! | [`distance`] | largest distance of plane cubics from line segments |
//! | [`fft`] | transforms and convolutions of lines and maps |
//! | [`linear`] | symmetric systems (skyline Cholesky, Woodbury), tridiagonal ones, Krylov methods |
//! | [`qp`] | quadratic programs: bounds, non-negativity, chains of neighbours |
//! | [`motion`] | motions between states, and motions given by a law of time |
//! | [`slope`] | slopes of a map over a base length |
//! | [`spectrum`] | power spectral densities of a rectangle of samples |
//! | [`parallel`] | loops over all threads |
//! | [`precision`] | single precision where it is exact enough |
//! | the others | interpolation, polynomials, quadrature, statistics, sorting by counting |

pub mod bspline;
pub mod counting;
pub mod distance;
pub mod fft;
pub mod keys;
pub mod linear;
pub mod motion;
pub mod orthogonal;
pub mod parallel;
pub mod pareto;
pub mod polynomial;
pub mod precision;
pub mod qp;
pub mod quadrature;
pub mod slope;
pub mod spectrum;
pub mod statistics;
pub mod vectors;
