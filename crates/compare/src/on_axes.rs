//! Residual and time of a plan when all axes of a machine run it.

use planish_form::Form;
use planish_types::{
    AxesMotion, Invalid, Removal, Surface,
    outcome::{axes::MotionReport, verdict::AxesVerdict},
    text::significant,
};
use serde::Serialize;

/// Checks that the outcome of a motion names as many axes and units as the motion has, `axes`.
///
/// # Errors
/// Refuses an outcome that names another number of axes or of units.
pub fn check_names(outcome: &MotionReport, axes: usize) -> Result<(), Invalid> {
    if outcome.axes.len() == axes && outcome.units.len() == axes {
        return Ok(());
    }
    let problem = format!("names {} axes of {axes}", outcome.axes.len());
    Err(Invalid::whole("outcome", problem, "run planish axes motion again"))
}

/// Residual, time and limits of a plan that all axes of the machine run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct OnAxes {
    /// Names of the axes, in the order of the machine file.
    pub axes: Vec<String>,
    /// RMS of the residual along z, mean removed, nm.
    pub rms_nm: f64,
    /// RMS of the residual along the normal of the form, mean along z removed, nm; `null` where the form is not known.
    pub rms_along_normal_nm: Option<f64>,
    /// Duration of the motion, s.
    pub total_time_s: f64,
    /// Additional time with the tool on, s, because an axis is slower than planned.
    pub added_tool_on_time_s: f64,
    /// Largest distance of the executed contact point from the path, um.
    pub contact_deviation_um: f64,
    /// Largest distance of the tip of the tool from the surface, along the tool, um.
    pub gap_um: f64,
    /// True if the verdict found that all axes keep their limits.
    pub limits_respected: bool,
}

impl OnAxes {
    /// Collects the numbers of a motion from its outcome, its duration, its verdict, and its predicted removal.
    /// `form` is the form of the part; without it there is no residual along the normal.
    pub fn new(
        outcome: &MotionReport,
        motion: &AxesMotion,
        verdict: &AxesVerdict,
        removal: &Removal,
        form: Option<&Form>,
    ) -> Self {
        let residual = removal.residual();
        Self {
            axes: outcome.axes.clone(),
            rms_nm: residual.statistics().rms,
            rms_along_normal_nm: form.map(|form| rms_along_normal_nm(residual, form)),
            total_time_s: motion.total_time_s(),
            added_tool_on_time_s: outcome.added_tool_on_time_s,
            contact_deviation_um: outcome.contact_deviation_um,
            gap_um: outcome.gap_um,
            limits_respected: verdict.limits_respected,
        }
    }

    /// Returns a sentence on the plan `name` when all axes of the machine run it: residual, time, deviations of the
    /// tool, and whether the limits are kept.
    pub fn sentence(&self, name: &str) -> String {
        let mut longer = String::new();
        if self.added_tool_on_time_s > 0.0 {
            let added_s = significant(self.added_tool_on_time_s, 3);
            longer = format!(", with the tool on for {added_s} s longer than planned");
        }
        let normal = match self.rms_along_normal_nm {
            Some(rms_nm) => format!(" ({rms_nm:.4} nm along the normal)"),
            None => String::new(),
        };
        format!(
            "{name} on the axes {}: {:.4} nm RMS{normal} in {:.2} s{longer}; contact point within {} um of the path, tip of \
             the tool within {} um of the surface; limits of the axes {}",
            self.axes.join(", "),
            self.rms_nm,
            self.total_time_s,
            significant(self.contact_deviation_um, 3),
            significant(self.gap_um, 3),
            if self.limits_respected { "kept" } else { "NOT kept" }
        )
    }
}

/// Returns the RMS of the residual along the normal of the form, nm, from the heights (h) along z. It leaves out
/// invalid pixels, and pixels at which the form is not defined:
///
/// ```text
/// RMS of (h - mean of h) cos(slope angle)
/// ```
///
/// The mean along z does not count as residual, as in all RMS of a report. It is subtracted before the projection,
/// because the projection of a constant onto the normal varies over the part.
fn rms_along_normal_nm(residual: &Surface, form: &Form) -> f64 {
    let grid = residual.grid();
    let on_form: Vec<(f64, f64)> = residual
        .height_nm()
        .indexed_iter()
        .filter(|(_, height)| !height.is_nan())
        .filter_map(|((r, c), height)| {
            Some((
                *height,
                form.point([grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)])?.cosine(),
            ))
        })
        .collect();
    let count = on_form.len().max(1) as f64;
    let mean = on_form.iter().map(|(h, _)| h).sum::<f64>() / count;
    (on_form.iter().map(|(h, cosine)| ((h - mean) * cosine).powi(2)).sum::<f64>() / count).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_residual_along_the_normal_is_shorter_by_the_cosine() {
        // Four pixels at the same distance r from the vertex of a sphere of the radius R = r / 0.6: the cosine is 0.8.
        let axis = planish_types::Axis::new(-3.0, 6.0, 2).unwrap();
        let grid = planish_types::Grid { x: axis, y: axis };
        let heights = ndarray::array![[8.0, 6.0], [6.0, 8.0]];
        let surface = Surface::new(grid, heights).unwrap();
        let form = Form::sphere(3.0 * 2.0_f64.sqrt() / 0.6, [0.0, 0.0]).unwrap();
        let rms_nm = rms_along_normal_nm(&surface, &form);
        assert!((rms_nm - 0.8).abs() < 1e-12, "{rms_nm}"); // rounding of a few operations
    }
}
