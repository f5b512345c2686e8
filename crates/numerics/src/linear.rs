//! Systems of linear equations and least squares without bounds.
//!
//! | module | matrix | method |
//! |---|---|---|
//! | [`skyline`] | symmetric positive definite, sparse or full | blocked Cholesky within the skyline |
//! | [`woodbury`] | the same less a few outer products | correction of the inverse |
//! | [`tridiagonal`] | tridiagonal | elimination |
//! | [`lsqr`] | known by products | damped least squares, bidiagonalisation |
//! | [`lanczos`] | known by products | the part of the large eigenvalues, Krylov space |
//! | [`power`] | known by products | largest eigenvalue |
//!
//! Most of the time is spent in two products: `block_product` in a factorisation, and
//! [`interleaved`] for a matrix that consists of products of columns.

mod block_product;
pub mod interleaved;
pub mod lanczos;
pub mod lsqr;
pub mod power;
pub mod skyline;
pub mod tridiagonal;
pub mod woodbury;
