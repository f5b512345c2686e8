//! Preparation and description of measured maps, for the solvers.
//!
//! * [`mod@prepare`]: clear aperture, outlier mask, level, fill and extension, in this order.
//! * [`outliers`]: finds pits and dust that are too narrow for the tool.
//! * [`mod@planish_form::low_order`]: Zernike, Legendre and Chebyshev terms by least squares.
//! * [`mod@fill`]: heights for holes.
//! * [`target`]: the form that the part is to have, fitted and subtracted.
//! * [`extension`]: heights beyond the clear aperture, four methods.
//! * [`binning`]: a map of fewer pixels.
//! * [`statistics`], [`psd`]: numbers that describe a map.
//! * [`quality`]: quantities that specify a mirror, of a map or of a [`profile`]; [`shape`]: the best
//!   shape; [`specification`]: limits on all of these quantities.
//! * [`mod@line`]: the desired removal of a profile, and the tool that is integrated across it.
//! * [`draw`]: pictures of maps and spectra.

// The command line names this library as any other program does.
extern crate self as planish_surface;

pub mod binning;
mod cli;
pub mod command;
mod distance;
pub mod draw;
pub mod extension;
mod figure;
pub mod fill;
pub mod line;
mod median;
pub mod outliers;
pub mod prepare;
pub mod profile;
pub mod psd;
pub mod quality;
pub mod shape;
pub mod specification;
pub mod statistics;
pub mod target;

pub use extension::{ExtensionSettings, extend};
pub use outliers::{OutlierSettings, Outliers};
pub use planish_form::low_order::{Family, LowOrderSettings, low_order};
pub use prepare::{Level, PrepareReport, PrepareSettings, Prepared, prepare, prepare_to};

use planish_types::Invalid;

/// Reason why the preparation refuses a map.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// A value that is not valid, such as a setting out of its range.
    #[error(transparent)]
    Invalid(#[from] Invalid),
    /// A clear aperture that covers a single row or column of pixels.
    #[error(
        "clear aperture: holds {rows} row(s) and {columns} column(s) of pixels; \
         a map needs at least 2 x 2, check its size and units"
    )]
    TooSmall {
        /// Number of rows of the bounding box of the aperture.
        rows: usize,
        /// Number of columns of the bounding box of the aperture.
        columns: usize,
    },
    /// The outlier mask would take more than the allowed fraction of the pixels.
    #[error(
        "outlier mask: takes {masked} of {valid} valid pixels ({percent:.2} %, at most {limit} %); \
         raise the thresholds, give the right feature size, or a smaller margin (`outlier_dilate_px`)"
    )]
    TooManyMasked {
        /// Number of pixels that the mask would take.
        masked: usize,
        /// Number of valid pixels.
        valid: usize,
        /// Ratio of masked to valid pixels, %.
        percent: f64,
        /// Largest allowed ratio, %.
        limit: f64,
    },
    /// The valid pixels do not define a plane.
    #[error(
        "plane: {valid} valid pixel(s) do not define one (at least 6, not all on one line); \
         use the level piston"
    )]
    NoPlane {
        /// Number of valid pixels.
        valid: usize,
    },
}
