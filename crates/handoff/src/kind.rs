//! Table of the kinds of artifact directories: the arrays and files of each, with units and meaning. Readers, writers
//! and `docs/formats.md` all use it.

mod spectra;

pub use spectra::{PSD, SPECIFICATION};

/// Name of the manifest in an artifact directory.
pub const MANIFEST: &str = "manifest.json";

/// Element type of a stored array, with NumPy's name for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dtype {
    /// 64-bit float, `<f8`.
    F64,
    /// 64-bit signed integer, `<i8`.
    I64,
    /// Unsigned byte that is 0 or 1, `|u1` (`|b1` is read, too).
    U8,
}

impl Dtype {
    /// Returns the number of bytes of an element.
    pub(crate) fn bytes(self) -> usize {
        match self {
            Self::F64 | Self::I64 => 8,
            Self::U8 => 1,
        }
    }

    /// Returns NumPy's name of the type, such as `<f8`.
    pub fn numpy(self) -> &'static str {
        match self {
            Self::F64 => "<f8",
            Self::I64 => "<i8",
            Self::U8 => "|u1",
        }
    }
}

/// Definition of one array of a kind of artifact.
#[derive(Debug)]
pub struct ArrayDef {
    /// Name of the array; its file is `<name>.npy`.
    pub name: &'static str,
    /// Element type.
    pub dtype: Dtype,
    /// Sizes along the axes. Each is a number, a symbol such as `n` that the arrays of the kind share, or a symbol
    /// with `+1`.
    pub shape: &'static [&'static str],
    /// Names of the axes, the slowest first.
    pub axes: &'static [&'static str],
    /// Unit of the elements, such as `mm`.
    pub unit: &'static str,
    /// True if an element may be NaN, which marks an invalid pixel.
    pub nan_allowed: bool,
    /// Value of all elements if a directory without a manifest lacks the file; `None` if the array has no such value.
    pub default: Option<u8>,
    /// Version of the kind that added the array, if the array is optional; otherwise `None`. An artifact without it has
    /// the version before, and its elements are `default`; without a default the array is empty.
    pub optional_since: Option<u32>,
    /// Description of the array in one sentence.
    pub doc: &'static str,
}

/// Definition of a kind of artifact directory: the arrays and files in it.
#[derive(Debug)]
pub struct Kind {
    /// Name of the kind in the manifest, such as `surface`.
    pub name: &'static str,
    /// Version of the layout; a reader refuses a newer one.
    pub version: u32,
    /// Description of the kind.
    pub doc: &'static str,
    /// Frame that the coordinates refer to, in words.
    pub frame: &'static str,
    /// Definitions of the arrays, in their order.
    pub arrays: &'static [ArrayDef],
    /// Names of the files beside the arrays and the manifest.
    pub files: &'static [&'static str],
}

impl Kind {
    /// Returns true if the readers of this kind use the numbers of the manifest's outcome, not the
    /// arrays. They then record the hash of the outcome.
    pub(crate) fn is_read_by_outcome(&self) -> bool {
        self.arrays.is_empty() || self.name == SPECIFICATION.name
    }

    /// Returns the version of an artifact that has the first `arrays` arrays. Optional arrays at the end may be
    /// absent.
    pub(crate) fn version_of(&self, arrays: usize) -> u32 {
        let lacking = &self.arrays[arrays..];
        let oldest =
            lacking.iter().map(|a| a.optional_since.expect("only optional ones may be absent"));
        oldest.min().map_or(self.version, |since| since - 1)
    }

    /// Returns the names of all files that a directory of this kind may hold.
    pub(crate) fn file_names(&self) -> impl Iterator<Item = String> {
        let arrays = self.arrays.iter().map(|a| format!("{}.npy", a.name));
        let beside = self.files.iter().map(|f| f.to_string());
        arrays.chain(beside).chain([String::from(MANIFEST)])
    }
}

const MAP_FRAME: &str =
    "part coordinates; arrays are [y, x]; row 0 is the smallest y; x and y ascend uniformly";
const TIF_FRAME: &str =
    "offset from the tool centre (pixel - tool); arrays are [y, x]; row 0 is the smallest y";
/// Frame of a path or a motion in the coordinates of the axes of a machine. The manifest states it in place of the
/// frame of the kind.
pub const MACHINE_FRAME: &str = "machine coordinates; the last axis is [x, y]";
const PATH_FRAME: &str = "part coordinates; the last axis is [x, y]";

const fn array(
    name: &'static str,
    dtype: Dtype,
    shape: &'static [&'static str],
    axes: &'static [&'static str],
    unit: &'static str,
    doc: &'static str,
) -> ArrayDef {
    ArrayDef {
        name,
        dtype,
        shape,
        axes,
        unit,
        nan_allowed: false,
        default: None,
        optional_since: None,
        doc,
    }
}

const fn or_nan(def: ArrayDef) -> ArrayDef {
    ArrayDef { nan_allowed: true, ..def }
}

const fn or_default(def: ArrayDef, value: u8) -> ArrayDef {
    ArrayDef { default: Some(value), ..def }
}

const fn optional(def: ArrayDef, value: u8, since: u32) -> ArrayDef {
    ArrayDef { default: Some(value), optional_since: Some(since), ..def }
}

/// Makes the definition of an optional array that has no default, added in the version `since`.
const fn may_be_absent(def: ArrayDef, since: u32) -> ArrayDef {
    ArrayDef { optional_since: Some(since), ..def }
}

const X: ArrayDef = array("x_mm", Dtype::F64, &["nx"], &["x"], "mm", "Pixel centres along x.");
const Y: ArrayDef = array("y_mm", Dtype::F64, &["ny"], &["y"], "mm", "Pixel centres along y.");

/// Kind of a height map, nm: measured surface error, or desired removal.
pub const SURFACE: Kind = Kind {
    name: "surface",
    version: 2,
    doc: "A height map: a measured surface error, or the desired removal.",
    frame: MAP_FRAME,
    arrays: &[
        or_nan(array(
            "height_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Height; positive = material above the target; NaN = invalid pixel.",
        )),
        X,
        Y,
        may_be_absent(
            or_nan(array(
                "deviation_nm",
                Dtype::F64,
                &["ny", "nx"],
                &["y", "x"],
                "nm",
                "Standard deviation of the height, from repeated measurements; NaN = unknown.",
            )),
            2,
        ),
    ],
    files: &[FORM_FILE],
};

/// Name of the file with the form of the part, beside the arrays of a surface.
pub const FORM_FILE: &str = "form.json";

/// Kind of a tool influence function, the removal rate in nm/s of a resting tool.
pub const TIF: Kind = Kind {
    name: "tif",
    version: 1,
    doc: "A tool influence function: the removal rate of the resting tool.",
    frame: TIF_FRAME,
    arrays: &[
        array(
            "rate_nm_per_s",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm/s",
            "Removal rate at the offset (pixel - tool); zero outside its samples.",
        ),
        X,
        Y,
    ],
    files: &[],
};

/// Kind of a tool influence function that varies over the part.
pub const TOOL: Kind = Kind {
    name: "tool",
    version: 5,
    doc: "A tool influence function that varies over the part. The removal rate at the pixel x of a tool at p is a sum over \
          the kernels: weight of the kernel at p, times its rate at x - p. The factor of the pixel and the factor of the \
          time since the start of the motion multiply it. Every flag `--tif` takes it. Kernels, weights and the factor of the \
          pixels are interpolated by Keys' cubic convolution, and the factor of the time linearly. Beyond their samples, \
          weights and factors are those of the nearest sample.",
    frame: "kernels by offset (pixel - tool), weights and factor in part coordinates; arrays are [y, x]",
    arrays: &[
        array(
            "rate_nm_per_s",
            Dtype::F64,
            &["k", "my", "mx"],
            &["kernel", "y", "x"],
            "nm/s",
            "Kernels at the offset (pixel - tool); zero outside their samples. A single one may be negative.",
        ),
        array("offset_x_mm", Dtype::F64, &["mx"], &["x"], "mm", "Offsets of the kernels along x."),
        array("offset_y_mm", Dtype::F64, &["my"], &["y"], "mm", "Offsets of the kernels along y."),
        array(
            "weight",
            Dtype::F64,
            &["k", "ny", "nx"],
            &["kernel", "y", "x"],
            "1",
            "Weight of every kernel at a grid of tool positions, which may be much coarser than the map.",
        ),
        array("x_mm", Dtype::F64, &["nx"], &["x"], "mm", "Tool positions of the weights along x."),
        array("y_mm", Dtype::F64, &["ny"], &["y"], "mm", "Tool positions of the weights along y."),
        may_be_absent(
            array(
                "time_s",
                Dtype::F64,
                &["m"],
                &["time"],
                "s",
                "Times since the start of the motion; ascending. One time for a rate that does not change.",
            ),
            2,
        ),
        may_be_absent(
            array(
                "time_factor",
                Dtype::F64,
                &["m"],
                &["time"],
                "1",
                "Factor of the rate at these times.",
            ),
            2,
        ),
        may_be_absent(
            array(
                "factor",
                Dtype::F64,
                &["py", "px"],
                &["y", "x"],
                "1",
                "Factor of the removal at a pixel of the part, for causes that act there.",
            ),
            3,
        ),
        may_be_absent(
            array(
                "factor_x_mm",
                Dtype::F64,
                &["px"],
                &["x"],
                "mm",
                "Places of the factor along x.",
            ),
            3,
        ),
        may_be_absent(
            array(
                "factor_y_mm",
                Dtype::F64,
                &["py"],
                &["y"],
                "mm",
                "Places of the factor along y.",
            ),
            3,
        ),
        may_be_absent(
            array(
                "azimuth_weight",
                Dtype::F64,
                &["k", "na"],
                &["kernel", "azimuth"],
                "1",
                "Factor of the weight of every kernel by the azimuth of the tool, for tools that turn.",
            ),
            4,
        ),
        may_be_absent(
            array(
                "azimuth_deg",
                Dtype::F64,
                &["na"],
                &["azimuth"],
                "deg",
                "Azimuths of these factors from positive x towards positive y: uniform over one turn, without its end.",
            ),
            4,
        ),
        may_be_absent(
            array(
                "azimuth_middle_mm",
                Dtype::F64,
                &["2"],
                &["x|y"],
                "mm",
                "Point of the part about which the tool turns.",
            ),
            4,
        ),
        may_be_absent(
            array(
                "heading_weight",
                Dtype::F64,
                &["k", "nh"],
                &["kernel", "heading"],
                "1",
                "Factor of the weight of every kernel by the direction of the motion, for tools that turn with it.",
            ),
            5,
        ),
        may_be_absent(
            array(
                "heading_deg",
                Dtype::F64,
                &["nh"],
                &["heading"],
                "deg",
                "Directions of these factors from positive x towards positive y: uniform over one turn, without its end.",
            ),
            5,
        ),
    ],
    files: &[],
};

/// Kind of a tool path: its segments, dwell points and the state of the tool.
pub const TOOL_PATH: Kind = Kind {
    name: "tool_path",
    version: 1,
    doc: "A tool path: n segments between n+1 velocity control points.",
    frame: PATH_FRAME,
    arrays: &[
        array(
            "point_mm",
            Dtype::F64,
            &["n+1", "2"],
            &["point", "x|y"],
            "mm",
            "Velocity control points: the ends of the segments.",
        ),
        array(
            "dwell_point_mm",
            Dtype::F64,
            &["n", "2"],
            &["segment", "x|y"],
            "mm",
            "Dwell points, one per segment.",
        ),
        or_default(
            array(
                "tool_on",
                Dtype::U8,
                &["n"],
                &["segment"],
                "1",
                "0 where the tool is lifted and removes nothing.",
            ),
            1,
        ),
        or_default(
            array(
                "pass_idx",
                Dtype::I64,
                &["n"],
                &["segment"],
                "1",
                "Contiguous pass or region that the segment belongs to.",
            ),
            0,
        ),
    ],
    files: &[],
};

/// Kind of the dwell times of a tool path, s, one per segment.
pub const DWELL: Kind = Kind {
    name: "dwell",
    version: 1,
    doc: "Dwell times, one per segment of a tool path.",
    frame: PATH_FRAME,
    arrays: &[array("dwell_s", Dtype::F64, &["n"], &["segment"], "s", "Dwell time; >= 0.")],
    files: &[],
};

/// Earlier name of the kind [`DWELL_DENSITY`]; `feed` now means the feedrate only. The error message of a reader
/// names the new kind.
pub(crate) const FORMER_DWELL_DENSITY: &str = "feed";

/// Kind of the dwell-time density along a path, the time per length. It is the inverse of the feedrate.
pub const DWELL_DENSITY: Kind = Kind {
    name: "dwell_density",
    version: 1,
    doc: "Dwell-time density at m nodes along a path; the method in the manifest says what lies between them.",
    frame: PATH_FRAME,
    arrays: &[
        array(
            "arc_length_mm",
            Dtype::F64,
            &["m"],
            &["node"],
            "mm",
            "Length along the path; ascending within a pass.",
        ),
        array(
            "dwell_density_s_per_mm",
            Dtype::F64,
            &["m"],
            &["node"],
            "s/mm",
            "Dwell-time density: the inverse of the feedrate.",
        ),
        array("point_mm", Dtype::F64, &["m", "2"], &["node", "x|y"], "mm", "Where the node is."),
        or_default(array("pass_idx", Dtype::I64, &["m"], &["node"], "1", "Pass of the node."), 0),
        or_default(
            array(
                "corner",
                Dtype::U8,
                &["m"],
                &["node"],
                "1",
                "1 where the point is the control point of a parabolic blend between its neighbours.",
            ),
            0,
        ),
    ],
    files: &[],
};

/// Kind of a motion of the tool along x and y over time.
pub const TRAJECTORY: Kind = Kind {
    name: "trajectory",
    version: 2,
    doc: "A motion: k cubic polynomials per axis in segment-local time, p(u) = c0 + c1 u + c2 u^2 + c3 u^3, u = t - break_time_s[i].",
    frame: PATH_FRAME,
    arrays: &[
        array(
            "break_time_s",
            Dtype::F64,
            &["k+1"],
            &["break"],
            "s",
            "Start of every segment, and the end of the last.",
        ),
        array(
            "coefficient_mm",
            Dtype::F64,
            &["k", "2", "4"],
            &["segment", "x|y", "order"],
            "mm/s^order",
            "Ascending coefficients c0..c3.",
        ),
        or_default(
            array(
                "tool_on",
                Dtype::U8,
                &["k"],
                &["segment"],
                "1",
                "0 where the tool removes nothing.",
            ),
            1,
        ),
        array(
            "dwell_index",
            Dtype::I64,
            &["k"],
            &["segment"],
            "1",
            "Dwell point that the segment serves; -1 when none.",
        ),
        optional(
            array(
                "rate_factor",
                Dtype::F64,
                &["k"],
                &["segment"],
                "1",
                "Removal rate of the tool relative to its TIF, from a log with the beam current; >= 0.",
            ),
            1,
            2,
        ),
    ],
    files: &[],
};

/// Kind of a motion of all axes of a machine, linear and rotary.
pub const AXES: Kind = Kind {
    name: "axes",
    version: 1,
    doc: "A motion of all n axes of a machine: k cubic polynomials per axis in segment-local time, as those of a \
          trajectory. The outcome of the manifest names the axes, in the order of the machine file: the linear axes, then \
          the rotary ones. That of planish axes states the distance of the executed contact point from the plan. \
          planish import writes the kind from a program or a log of all axes.",
    frame: "positions of the axes of a machine, as they read",
    arrays: &[
        array(
            "break_time_s",
            Dtype::F64,
            &["k+1"],
            &["break"],
            "s",
            "Start of every segment, and the end of the last.",
        ),
        array(
            "coefficient_mm_or_deg",
            Dtype::F64,
            &["k", "n", "4"],
            &["segment", "axis", "order"],
            "mm/s^order, deg/s^order",
            "Ascending coefficients c0..c3; in mm for a linear axis and in degrees for a rotary one.",
        ),
        array("tool_on", Dtype::U8, &["k"], &["segment"], "1", "0 where the tool removes nothing."),
        array(
            "dwell_index",
            Dtype::I64,
            &["k"],
            &["segment"],
            "1",
            "Dwell point that the segment serves; -1 when none.",
        ),
    ],
    files: &[],
};

/// Kind of the position of a part on a machine, as a transform of coordinates.
pub const TRANSFORM: Kind = Kind {
    name: "transform",
    version: 1,
    doc: "Where a part lies: q = matrix (p - centre) + image takes a point p of the part to the point q of the machine, or of another map.",
    frame: "from part coordinates to machine coordinates; the last axis is [x, y]",
    arrays: &[
        array(
            "matrix",
            Dtype::F64,
            &["2", "2"],
            &["x|y of q", "x|y of p"],
            "1",
            "Rotation, with a scale, or any matrix; mirrored where the axes of the machine are.",
        ),
        array(
            "centre_mm",
            Dtype::F64,
            &["2"],
            &["x|y"],
            "mm",
            "Point of the part about which it turns.",
        ),
        array("image_mm", Dtype::F64, &["2"], &["x|y"], "mm", "Where that point goes."),
        array(
            "covariance_mm2",
            Dtype::F64,
            &["6", "6"],
            &["parameter", "parameter"],
            "mm^2",
            "Covariance of image x and y, and of matrix xx, xy, yx, yy times 1 mm.",
        ),
    ],
    files: &[],
};

/// Kind of the predicted removal and residual of a motion, as maps.
pub const REMOVAL: Kind = Kind {
    name: "removal",
    version: 1,
    doc: "What a trajectory is predicted to remove, and what remains.",
    frame: MAP_FRAME,
    arrays: &[
        array("removal_nm", Dtype::F64, &["ny", "nx"], &["y", "x"], "nm", "Predicted removal."),
        or_nan(array(
            "residual_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Desired removal minus predicted removal; NaN = invalid pixel.",
        )),
        X,
        Y,
    ],
    files: &[],
};

/// Kind of the maps of removal at chosen times of a run.
pub const FRAMES: Kind = Kind {
    name: "frames",
    version: 1,
    doc: "What a trajectory has removed at chosen times, on every s-th pixel of the map so that it stays small.",
    frame: MAP_FRAME,
    arrays: &[
        array(
            "time_s",
            Dtype::F64,
            &["m"],
            &["frame"],
            "s",
            "Times of the frames; the last is the end of the motion.",
        ),
        array(
            "removal_nm",
            Dtype::F64,
            &["m", "ny", "nx"],
            &["frame", "y", "x"],
            "nm",
            "Removal from the start to the time of the frame.",
        ),
        X,
        Y,
    ],
    files: &[],
};

/// Kind of the rounds of a refinement of dwell times, or of the plans of a trade-off between residual and time.
pub const ITERATIONS: Kind = Kind {
    name: "iterations",
    version: 1,
    doc: "The rounds of a refinement, the first being the plan before any correction; or the plans \
          of a trade-off by rising price of time.",
    frame: PATH_FRAME,
    arrays: &[
        array(
            "dwell_s",
            Dtype::F64,
            &["m", "n"],
            &["round", "segment"],
            "s",
            "Time of every segment in the motion.",
        ),
        array(
            "rms_nm",
            Dtype::F64,
            &["m"],
            &["round"],
            "nm",
            "RMS (mean removed) of the executed residual.",
        ),
        array("total_time_s", Dtype::F64, &["m"], &["round"], "s", "Total time of the motion."),
        array(
            "stretched",
            Dtype::I64,
            &["m"],
            &["round"],
            "1",
            "Segments whose dwell time the machine needed stretched.",
        ),
    ],
    files: &["pareto.svg"],
};

/// Kind of the bound of the residual on any path.
pub const BOUND: Kind = Kind {
    name: "bound",
    version: 1,
    doc: "Residual RMS that no path and no motion of a tool can beat in a run time; everything is in the manifest's \
          outcome.",
    frame: MAP_FRAME,
    arrays: &[],
    files: &[],
};

/// Kind of the verdict: whether a motion keeps the limits of a machine.
pub const VERDICT: Kind = Kind {
    name: "verdict",
    version: 1,
    doc: "Whether a trajectory keeps the limits of a machine; everything is in the manifest's outcome.",
    frame: PATH_FRAME,
    arrays: &[],
    files: &[],
};

/// Kind of the effect of process errors on a residual: its distribution over the runs.
pub const TOLERANCE: Kind = Kind {
    name: "tolerance",
    version: 1,
    doc: "What the errors of a process add to the residual of a plan: its distribution over the runs, and where \
          it scatters. What each error adds is in the manifest's outcome. There and here every RMS is without what \
          `settings.free` says: the mean, or the best plane (`plane`), which `rms_nm` of other kinds keeps.",
    frame: MAP_FRAME,
    arrays: &[
        array(
            "part",
            Dtype::F64,
            &["m"],
            &["level"],
            "1",
            "Parts of the runs, ascending from 0 to 1.",
        ),
        array(
            "rms_nm",
            Dtype::F64,
            &["m"],
            &["level"],
            "nm",
            "RMS of the residual (free terms removed) that this part of the runs is below.",
        ),
        or_nan(array(
            "deviation_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Standard deviation over the runs of the residual of a pixel; NaN = invalid pixel.",
        )),
        X,
        Y,
    ],
    files: &[],
};

/// Kind of the parameters of machine and tool that are estimated from the measured removal of a run.
pub const RECONCILIATION: Kind = Kind {
    name: "reconciliation",
    version: 1,
    doc: "What a run teaches of machine and tool: measured and predicted removal, and what is left. The parameters \
          with their standard errors, those that the data do not determine with the reason, and the removal by band \
          are in the manifest's outcome.",
    frame: MAP_FRAME,
    arrays: &[
        or_nan(array(
            "measured_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Map before minus map after, without the low-order terms of the metrology; NaN = invalid in one of them.",
        )),
        array(
            "planned_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Removal that the plan promised.",
        ),
        array(
            "predicted_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Removal with all free parameters at their estimates.",
        ),
        array(
            "metrology_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Low-order terms by which the two measurements differ.",
        ),
        or_nan(array(
            "rest_nm",
            Dtype::F64,
            &["ny", "nx"],
            &["y", "x"],
            "nm",
            "Measured minus predicted removal.",
        )),
        array(
            "correlation",
            Dtype::F64,
            &["p", "p"],
            &["unknown", "unknown"],
            "1",
            "Correlations of the estimates, in the order of `outcome.correlation_of`.",
        ),
        X,
        Y,
    ],
    files: &["reconcile.svg"],
};

/// Kind of the decision to run again or to stop.
pub const DECISION: Kind = Kind {
    name: "decision",
    version: 1,
    doc: "The decision to run again or to stop. The outcome of the manifest has the residual on the mirror, the expected \
          residual after the next run, the gain, its certainty, and the time of the run.",
    frame: MAP_FRAME,
    arrays: &[],
    files: &[],
};

/// Kind of the summary of a campaign, which is several runs on a mirror.
pub const CAMPAIGN: Kind = Kind {
    name: "campaign",
    version: 1,
    doc: "A campaign on the virtual machine, run by run. It has the residual with learning, without it, and with a known \
          tool, the learnt values beside the hidden truth, and the decision after every run. The numbers are in the \
          outcome of the manifest.",
    frame: MAP_FRAME,
    arrays: &[],
    files: &["campaign.html", "campaign.svg", "campaign.csv"],
};

/// Kind of the report of one or several runs: summary, page and figures.
pub const REPORT: Kind = Kind {
    name: "report",
    version: 1,
    doc: "The summary of one or several runs, a page to look at, and its figures (see report.md).",
    frame: MAP_FRAME,
    arrays: &[],
    files: &[
        "summary.json",
        "table.csv",
        "front.csv",
        "report.html",
        "overview.svg",
        "maps.svg",
        "tool.svg",
        "axes.svg",
        "path.svg",
        "motion.svg",
        "dwell.svg",
        "histogram.svg",
        "spectrum.svg",
        "refinement.svg",
        "front.svg",
    ],
};

/// Kind of the figures of a plan, as image files for papers and lab books.
pub const FIGURES: Kind = Kind {
    name: "figures",
    version: 1,
    doc: "The figures of a plan in one format, for papers and lab books (see report.md).",
    frame: MAP_FRAME,
    arrays: &[],
    files: &[
        "overview.pdf",
        "overview.png",
        "overview.svg",
        "maps.pdf",
        "maps.png",
        "maps.svg",
        "tool.pdf",
        "tool.png",
        "tool.svg",
        "axes.pdf",
        "axes.png",
        "axes.svg",
        "path.pdf",
        "path.png",
        "path.svg",
        "motion.pdf",
        "motion.png",
        "motion.svg",
        "dwell.pdf",
        "dwell.png",
        "dwell.svg",
        "histogram.pdf",
        "histogram.png",
        "histogram.svg",
        "spectrum.pdf",
        "spectrum.png",
        "spectrum.svg",
        "refinement.pdf",
        "refinement.png",
        "refinement.svg",
        "front.pdf",
        "front.png",
        "front.svg",
    ],
};

/// Kind of the results of a sweep: a table of its plans, and the fronts of residual against time.
pub const SWEEP: Kind = Kind {
    name: "sweep",
    version: 1,
    doc: "The plans of a sweep: a table, the fronts of residual against time, and a page whose points open the reports \
          of the plans. The names of the plans on the front, and of the one that is to be run, are in the manifest's \
          outcome (see sweeps.md).",
    frame: MAP_FRAME,
    arrays: &[],
    files: &["table.csv", "report.html", "front.svg", "front-95-percent.svg"],
};

/// All kinds, in the order in which a pipeline makes them.
pub const ALL: [&Kind; 23] = [
    &SURFACE,
    &TIF,
    &TOOL,
    &TOOL_PATH,
    &DWELL,
    &DWELL_DENSITY,
    &BOUND,
    &TRAJECTORY,
    &AXES,
    &TRANSFORM,
    &REMOVAL,
    &FRAMES,
    &ITERATIONS,
    &VERDICT,
    &TOLERANCE,
    &RECONCILIATION,
    &DECISION,
    &CAMPAIGN,
    &PSD,
    &SPECIFICATION,
    &REPORT,
    &FIGURES,
    &SWEEP,
];
