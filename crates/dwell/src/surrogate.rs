//! Cheap surrogates of the normal matrix of [`crate::bounded_least_squares`], which give its steps. The exact
//! gradient corrects their errors.
//!
//! Words of these files: a *cell* is a square of s x s pixels; the *energy* of a column is the sum of its squared
//! removal rates. Where H~ is factorised, the pixels of every cell are taken together,
//!
//! ```text
//! H~ = B' W^1/2 P W^1/2 B - U U',     P: mean over every cell, weighted                  (1)
//! ```
//!
//! with the matrices B, W and U of [`crate::bounded_least_squares`]. On pixels of the pitch h it loses the fraction
//! `s^2 h^2 / 12 <|grad R|^2> / <R^2>` of the energy of a column. The size s is the largest that loses no more than a
//! given fraction. U is exact: a mean over cells keeps sums.
//!
//! Where H~ is only multiplied by vectors, the map has one sample in every cell,
//!
//! ```text
//! H~ = C' W_c C - U U',     W_c: the weights of the pixels, shared linearly by the samples around         (2)
//! ```
//!
//! with C, the removal on the samples, by the splines of `model::fft_operator`. A sum of the product of two smooth TIFs
//! over the samples equals that over the pixels to many digits. At the rim of the weights the sharing costs `s^2 h^2 /
//! 12` of the curvature of the product. So (2) holds for details that the TIF hardly resolves, too; (1) loses several
//! times as much of these as of a column. The shared weights keep sums and first moments: U is exact for a piston and a
//! plane.
//!
//! | module | how `min q'd + d'H~d / 2` within the bounds is found |
//! |---|---|
//! | `ordered` | skyline Cholesky factorisations on the active sets |
//! | `convolved` | products with H~ by FFT: conjugate gradients on the active sets, or gradient steps |
//! | `two_level` | the preconditioner of these conjugate gradients: a lattice of B-splines, and the penalty |
//! | `stencils` | the matrix of that lattice |
//! | `resolution` | how large the cells and how wide the splines are |

mod convolved;
mod ordered;
mod resolution;
mod stencils;
mod two_level;

pub use convolved::{Convolved, Unbounded};
pub use ordered::{Ordered, Penalised};
pub use resolution::{
    MAX_LOSS_FACTORISED, MAX_LOSS_GRADIENT, MAX_LOSS_SEVERAL, MAX_LOSS_TWO_LEVEL, are_sparse,
    cell_size, factorisation_work, spline_pitch,
};

/// A surrogate H~ of the normal matrix.
pub enum Surrogate {
    /// Matrix (1) of the module, which is factorised.
    Ordered(Ordered),
    /// Operator (2) of the module, of which products are made by FFT.
    Convolved(Box<Convolved>),
}
