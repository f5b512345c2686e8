//! What there is to say of a path that was made: its statistics, and what the user should know.

use planish_types::{Surface, Tif, ToolPath};
use serde::Serialize;

use crate::statistics::{PathStatistics, PitchLimit, pitch_limit, statistics};

/// What there is to say of a path.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PathReport<R> {
    /// Numbers about the path.
    #[serde(flatten)]
    pub statistics: PathStatistics,
    /// What bounds the pitch; left out without a TIF.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pitch_limit: Option<PitchLimit>,
    /// What only the method of this path has to say.
    #[serde(flatten)]
    pub own: R,
    /// What the user should know.
    pub warnings: Vec<String>,
}

impl<R> PathReport<R> {
    /// Reports on `path` over the valid pixels of `surface`; `largest_pitch_mm` is the largest distance
    /// of its neighbouring lines, `warnings` are those of its method.
    pub fn new(
        path: &ToolPath,
        surface: &Surface,
        tif: Option<&Tif>,
        largest_pitch_mm: f64,
        own: R,
        mut warnings: Vec<String>,
    ) -> Self {
        let statistics = statistics(path, surface);
        let pitch_limit = tif.map(pitch_limit);
        if let Some(l) = pitch_limit.filter(|l| largest_pitch_mm > l.tif_size_sixth_mm) {
            warnings.push(format!(
                "the pitch of {largest_pitch_mm} mm is larger than a sixth of the TIF's size ({:.4} mm): \
                 the lines will show",
                l.tif_size_sixth_mm
            ));
        }
        if let Some(far) = statistics.coverage_mm.filter(|far| *far > largest_pitch_mm) {
            warnings.push(format!(
                "a pixel is {far:.4} mm from the path, more than the pitch of {largest_pitch_mm} mm: give \
                 a smaller pitch or a larger overscan"
            ));
        }
        Self { statistics, pitch_limit, own, warnings }
    }
}
