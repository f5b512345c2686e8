//! The form that a part is to have: a map less this form, as given or fitted; and maps whose heights or lateral axes
//! follow the surface.
//!
//! ```text
//! minimise  sum (z - c0 - bx x - by y - f(x, y; a))^2     over the valid pixels, low <= a <= high         (1)
//! (J' J + l diag(J' J)) step = J' r                       r = z - model, J = its derivatives by a         (2)
//! h_z = h_n / n_z                                         height along z from that along the normal       (3)
//! ```
//!
//! (1) is solved by the Levenberg-Marquardt method (2), from the QR factors of the scaled J (D. W. Marquardt, J. SIAM
//! 11 (1963) 431). A radius and the distances p and q move along their inverses, along which f is nearly linear. A
//! parameter at one of its bounds stays there while the step would take it beyond.
//!
//! (3) holds to first order in the height: nanometres against radii of millimetres and more. A map whose lateral axes
//! follow the surface is interpolated at the coordinates that [`planish_form::Development`] gives to every pixel.
//!
//! | symbol | variable | unit |
//! |---|---|---|
//! | z, r | `height_nm` | nm |
//! | c0, bx, by | `piston_nm`, `tilt_urad` | nm, urad |
//! | a | `parameters` | as named |

use nalgebra::DMatrix;
use ndarray::Array2;
use planish_form::{
    Development, Form, FormFile, ParameterFit, file::FitWord, low_order::bounding_box_mm,
};
use planish_types::{Invalid, Surface};
use rayon::prelude::*;
use serde::Serialize;

use crate::shape::fit::damped_step;

/// Number of nm in a mm.
const NM_PER_MM: f64 = 1e6;

/// Number of rows of J in (2) of the module that are factorised at once. Larger: more memory. Smaller: more time.
const ROWS: usize = 4096;

/// Largest number of steps, accepted or not. Larger: more time on a fit that does not end. Smaller: a fit may stop
/// before its minimum. Measured: a few steps where the start is good, 20 from a radius that is off by half.
const MAX_STEPS: usize = 200;

/// Length of a step in the scaled Jacobian, relative to the heights, at or below which a fit ends. Larger: it stops
/// before its minimum. Smaller: rounding keeps it going.
const LAST_STEP: f64 = 1e-13;

/// First damping (l in (2) of the module) after a step that failed, and the factor by which later steps change it.
/// Larger: shorter first steps. Smaller: more steps that fail.
const DAMPING: (f64, f64) = (1e-4, 10.0);

/// Smallest diagonal element of R of the scaled Jacobian at which its columns count as independent. Larger: refuses
/// parameters that the map determines. Smaller: accepts parameters that rounding decides.
const INDEPENDENT: f64 = 1e-9;

/// Target: the form that a part is to have, as a form file states it.
#[derive(Clone, Debug)]
pub struct Target {
    /// Content of the form file, with the parameters that a fit may change.
    pub file: FormFile,
    /// Heights of a form of the kind `map`; `None` for other kinds.
    pub map: Option<Surface>,
}

/// Form that was subtracted from a map, with the result of its fit.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TargetReport {
    /// Sentence that states the sign and the direction of the heights.
    pub convention: &'static str,
    /// Form file with the fitted numbers in place of the given ones.
    pub form: FormFile,
    /// Height at x = y = 0 that was subtracted with the form, nm.
    pub piston_nm: f64,
    /// Slopes along [x, y] that were subtracted with the form, urad.
    pub tilt_urad: [f64; 2],
    /// The parameters that were fitted.
    pub parameters: Vec<ParameterReport>,
    /// Population RMS of the map minus the form, mean removed, nm.
    pub rms_nm: f64,
    /// Number of steps of the fit.
    pub steps: usize,
}

/// A fitted parameter of a form.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ParameterReport {
    /// Name of the parameter, which ends with its unit.
    pub name: String,
    /// Value in the form file, in the unit of the parameter.
    pub given: f64,
    /// Value after the fit, in the unit of the parameter.
    pub value: f64,
    /// Standard error of the value, in its unit, under the assumption that the residual is white noise.
    pub standard_error: f64,
    /// Smallest and largest allowed value; `null` if the parameter has no bounds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bounds: Option<[f64; 2]>,
    /// True if the fit ended at a bound.
    pub at_bound: bool,
}

/// A parameter during the fit. It moves along a coordinate: its value, or the inverse of the value.
#[derive(Clone, Debug)]
struct Parameter {
    name: String,
    bounds: Option<[f64; 2]>,
    /// True if the coordinate is the inverse of the value.
    inverse: bool,
    /// Step of the difference quotient by the coordinate, in its unit.
    step: f64,
}

impl Parameter {
    fn coordinate(&self, value: f64) -> f64 {
        if self.inverse { 1.0 / value } else { value }
    }

    /// Returns the smallest and the largest value of the coordinate; infinite without bounds.
    fn ends(&self) -> [f64; 2] {
        let Some(bounds) = self.bounds else { return [f64::NEG_INFINITY, f64::INFINITY] };
        let [a, b] = bounds.map(|v| self.coordinate(v));
        [a.min(b), a.max(b)]
    }
}

/// Valid pixels of a map: positions, heights and indices, with the middle and the half diagonal of their bounding box.
struct Points {
    place_mm: Vec<[f64; 2]>,
    height_nm: Vec<f64>,
    index: Vec<(usize, usize)>,
    middle_mm: [f64; 2],
    half_mm: f64,
}

impl Points {
    fn valid(surface: &Surface) -> Self {
        let grid = surface.grid();
        let mut place_mm = Vec::new();
        let mut height_nm = Vec::new();
        let mut index = Vec::new();
        for ((r, c), z) in surface.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
            place_mm.push([grid.x.coordinate_mm(c), grid.y.coordinate_mm(r)]);
            height_nm.push(*z);
            index.push((r, c));
        }
        let [x, y] = bounding_box_mm(surface.height_nm(), grid);
        let middle_mm = [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1])];
        let half_mm = 0.5 * (x[1] - x[0]).hypot(y[1] - y[0]);
        Self { place_mm, height_nm, index, middle_mm, half_mm }
    }
}

/// Model (1) of the module at the parameters in `file`.
struct TargetModel<'a> {
    target: &'a Target,
    file: FormFile,
    parameters: Vec<Parameter>,
    tilted: bool,
}

impl TargetModel<'_> {
    /// Returns the number of unknowns: the piston, two tilts if they are fitted, and the parameters.
    fn unknowns(&self) -> usize {
        1 + 2 * usize::from(self.tilted) + self.parameters.len()
    }

    /// Returns the coordinates of the parameters at the values of the file.
    fn coordinates(&self) -> Vec<f64> {
        let mut file = self.file.clone();
        let values = self.parameters.iter();
        values.map(|p| p.coordinate(*file.parameter_mut(&p.name).expect("checked"))).collect()
    }

    fn file_at(&self, coordinates: &[f64]) -> FormFile {
        let mut file = self.file.clone();
        for (p, v) in self.parameters.iter().zip(coordinates) {
            *file.parameter_mut(&p.name).expect("checked") = p.coordinate(*v);
        }
        file
    }

    /// Returns the heights of the form at the points, nm; `None` if the form does not exist at every point.
    fn heights(&self, coordinates: &[f64], points: &Points) -> Option<Vec<f64>> {
        let file = FormFile { fit: None, ..self.file_at(coordinates) };
        let form = Form::new(&file, self.target.map.as_ref()).ok()?;
        let sags: Option<Vec<f64>> = points.place_mm.par_iter().map(|p| form.sag_mm(*p)).collect();
        sags.map(|sags| sags.into_iter().map(|mm| NM_PER_MM * mm).collect())
    }

    /// Returns the columns of J at the point `p` [x, y] for the piston and the tilts: 1, and x and y from the middle
    /// over the half diagonal.
    fn rigid(&self, p: [f64; 2], points: &Points) -> Vec<f64> {
        if !self.tilted {
            return vec![1.0];
        }
        let [x, y] = [0, 1].map(|k| (p[k] - points.middle_mm[k]) / points.half_mm);
        vec![1.0, x, y]
    }
    /// Returns the heights of the points minus the form and minus the piston and the tilts with the coefficients
    /// `rigid`, nm.
    fn left(&self, form: &[f64], rigid: &[f64], points: &Points) -> Vec<f64> {
        let places = points.place_mm.iter().zip(&points.height_nm).zip(form);
        let left = places.map(|((place, height), form)| {
            let columns = self.rigid(*place, points);
            let sum: f64 = columns.iter().zip(rigid).map(|(c, b)| c * b).sum();
            height - form - sum
        });
        left.collect()
    }
    /// Returns the column of J of the parameter `k`, a difference quotient; `None` if the form exists on neither side.
    fn column(&self, k: usize, coordinates: &[f64], points: &Points) -> Option<Vec<f64>> {
        let step = self.parameters[k].step;
        let [above, below] = [step, -step].map(|by| {
            let mut moved = coordinates.to_vec();
            moved[k] += by;
            self.heights(&moved, points)
        });
        // Where the form ends within a step, the difference is of one side.
        let (above, below, width) = match (above, below) {
            (Some(a), Some(b)) => (a, b, 2.0 * step),
            (Some(a), None) => (a, self.heights(coordinates, points)?, step),
            (None, Some(b)) => (self.heights(coordinates, points)?, b, step),
            (None, None) => return None,
        };
        Some(above.iter().zip(&below).map(|(a, b)| (a - b) / width).collect())
    }
    /// Returns the error about parameters that the pixels do not tell apart.
    fn undetermined(&self) -> Invalid {
        let names: Vec<&str> = self.parameters.iter().map(|p| p.name.as_str()).collect();
        let problem =
            format!("the valid pixels do not tell {} and the tilt apart", names.join(", "));
        Invalid::whole("target", problem, "hold one of them in `fit` of the form file")
    }

    /// Returns R of the QR factors of [J, r] with the columns of J scaled to length 1, and their lengths before.
    /// Returns `None` if the form does not exist, or if a column is 0 or not finite.
    fn factors(
        &self,
        coordinates: &[f64],
        left: &[f64],
        points: &Points,
    ) -> Option<(DMatrix<f64>, Vec<f64>)> {
        let columns: Option<Vec<Vec<f64>>> =
            (0..self.parameters.len()).map(|k| self.column(k, coordinates, points)).collect();
        let columns = columns?;
        let n = self.unknowns();
        let mut squares = vec![0.0; n];
        let row = |i: usize| {
            let rigid = self.rigid(points.place_mm[i], points);
            rigid.into_iter().chain(columns.iter().map(move |c| c[i]))
        };
        for i in 0..left.len() {
            squares.iter_mut().zip(row(i)).for_each(|(s, v)| *s += v * v);
        }
        let scale: Vec<f64> = squares.iter().map(|s| s.sqrt()).collect();
        if scale.iter().any(|s| !(s.is_finite() && *s > 0.0)) {
            return None;
        }
        let mut r = DMatrix::<f64>::zeros(0, n + 1);
        for start in (0..left.len()).step_by(ROWS) {
            let rows = ROWS.min(left.len() - start);
            let mut block = DMatrix::zeros(r.nrows() + rows, n + 1);
            block.rows_mut(0, r.nrows()).copy_from(&r);
            for i in 0..rows {
                let to = r.nrows() + i;
                for (k, v) in row(start + i).enumerate() {
                    block[(to, k)] = v / scale[k];
                }
                block[(to, n)] = left[start + i];
            }
            r = block.qr().r();
        }
        Some((r, scale))
    }
}

/// Returns `surface` minus the target, a piston and, unless the file holds it, a tilt, with the report of the fit.
/// Refuses a form file that is not valid, a form that does not exist at a valid pixel, no more pixels than unknowns,
/// and parameters that the pixels do not tell apart.
pub fn without_target(
    surface: &Surface,
    target: &Target,
) -> Result<(Surface, TargetReport), Invalid> {
    let points = Points::valid(surface);
    let model = model(target, &points)?;
    let mut coordinates = model.coordinates();
    let Some(form) = model.heights(&coordinates, &points) else {
        return Err(absent(target, surface, &points));
    };
    let n = model.unknowns();
    if points.place_mm.len() <= n {
        let problem = format!("has {} valid pixels for {n} unknowns", points.place_mm.len());
        return Err(Invalid::whole("target", problem, "give a larger map, or hold parameters"));
    }
    let first = n - model.parameters.len();
    let mut rigid = vec![0.0; first];
    let mut left = model.left(&form, &rigid, &points);
    let size = norm(&form).max(norm(&points.height_nm));
    let mut factors =
        model.factors(&coordinates, &left, &points).ok_or_else(|| model.undetermined())?;
    let mut damping = 0.0;
    let mut steps = 0;
    while steps < MAX_STEPS {
        steps += 1;
        let (r, scale) = &factors;
        let matrix = r.view((0, 0), (n, n)).into_owned();
        let right = r.view((0, n), (n, 1)).column(0).into_owned();
        let parameters = model.parameters.iter().zip(&coordinates);
        let room: Vec<[f64; 2]> =
            parameters.map(|(p, value)| p.ends().map(|end| end - value)).collect();
        // (2): [R; sqrt(l) I] step = [Q' r; 0]
        let (step, length) = damped_step(&matrix, scale, &right, &room, damping);
        let next: Vec<f64> = (0..coordinates.len())
            .map(|k| {
                let [low, high] = model.parameters[k].ends();
                (coordinates[k] + step[first + k]).clamp(low, high)
            })
            .collect();
        let moved: Vec<f64> = rigid.iter().zip(&step).map(|(b, s)| b + s).collect();
        let then = model.heights(&next, &points).map(|form| model.left(&form, &moved, &points));
        let ends = length <= LAST_STEP * size;
        match then {
            Some(then) if norm(&then) < norm(&left) => {
                (coordinates, rigid, left) = (next, moved, then);
                damping = if damping > DAMPING.0 { damping / DAMPING.1 } else { 0.0 };
                factors = model
                    .factors(&coordinates, &left, &points)
                    .ok_or_else(|| model.undetermined())?;
            }
            _ if ends || damping > 1e12 => break,
            _ => damping = if damping == 0.0 { DAMPING.0 } else { damping * DAMPING.1 },
        }
        if ends {
            break;
        }
    }
    let r = factors.0.view((0, 0), (n, n)).into_owned();
    if (0..n).any(|k| r[(k, k)].abs() < INDEPENDENT) {
        return Err(model.undetermined());
    }
    report(surface, &model, &points, (coordinates, rigid, left), (&r, &factors.1), steps)
}

fn norm(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Returns the model of a target at the values of its form file.
fn model<'a>(target: &'a Target, points: &Points) -> Result<TargetModel<'a>, Invalid> {
    target.file.check()?;
    let mut file = target.file.clone();
    let fit = file.fit.take().unwrap_or_default();
    let tilted = fit.get("tilt") != Some(&ParameterFit::Word(FitWord::Held));
    let half = points.half_mm;
    let mut parameters = Vec::new();
    for name in file.parameter_names() {
        let bounds = match fit.get(&name) {
            None | Some(ParameterFit::Word(FitWord::Held)) => continue,
            Some(ParameterFit::Word(FitWord::Free)) => None,
            Some(ParameterFit::Between(bounds)) => Some(*bounds),
        };
        let value = *file.parameter_mut(&name).expect("a name of the list");
        let inverse =
            matches!(name.as_str(), "radius_mm" | "radius_x_mm" | "radius_y_mm" | "p_mm" | "q_mm");
        let step = match name.as_str() {
            _ if inverse => 1e-4 / value.abs(),
            "conic_constant" => 1e-2,
            "theta_mrad" => 1e-4 * value,
            "rotation_deg" => 0.05,
            _ if name.starts_with("zernike") => 100.0,
            _ => match name.strip_prefix("even_term_").and_then(|n| n.parse::<i32>().ok()) {
                // 1 um at the edge of the part.
                Some(power) => 1e-3 / half.powi(power),
                None => 1e-3 * half,
            },
        };
        parameters.push(Parameter { name, bounds, inverse, step });
    }
    Ok(TargetModel { target, file, parameters, tilted })
}

/// Returns the error about a form that does not exist at every valid pixel.
fn absent(target: &Target, surface: &Surface, points: &Points) -> Invalid {
    let file = FormFile { fit: None, ..target.file.clone() };
    let form = match Form::new(&file, target.map.as_ref()) {
        Ok(form) => form,
        Err(e) => return e,
    };
    let lacking = points.place_mm.iter().position(|place| form.sag_mm(*place).is_none());
    let i = lacking.unwrap_or_default();
    let [x, y] = points.place_mm[i];
    let (r, c) = points.index[i];
    let problem = format!(
        "does not exist at ({x:.4}, {y:.4}) mm, where the map has {} nm",
        surface.height_nm()[[r, c]]
    );
    let remedy = "check the radius and the vertex of the form, or give a smaller clear aperture";
    Invalid::at_index("target", (r, c), problem, remedy)
}

/// Returns the map minus the model, and the report of the fit.
fn report(
    surface: &Surface,
    model: &TargetModel<'_>,
    points: &Points,
    (coordinates, rigid, left): (Vec<f64>, Vec<f64>, Vec<f64>),
    (r, scale): (&DMatrix<f64>, &[f64]),
    steps: usize,
) -> Result<(Surface, TargetReport), Invalid> {
    let mut map = Array2::from_elem(surface.height_nm().dim(), f64::NAN);
    for (place, v) in points.index.iter().zip(&left) {
        map[*place] = *v;
    }
    let rest = Surface::new(*surface.grid(), map)?;
    let n = scale.len();
    let first = n - coordinates.len();
    let spare = (left.len() - n) as f64;
    let deviation = (left.iter().map(|v| v * v).sum::<f64>() / spare).sqrt();
    let inverse = r.clone().try_inverse();
    let mut form = model.file_at(&coordinates);
    let mut file = model.file.clone();
    let parameters = model.parameters.iter().enumerate().map(|(k, p)| {
        let value = p.coordinate(coordinates[k]);
        let coordinate_error = inverse.as_ref().map_or(f64::INFINITY, |inverse| {
            inverse.row(first + k).norm() * deviation / scale[first + k]
        });
        // The derivative of 1 / c is 1 / c^2.
        let by_coordinate = if p.inverse { value * value } else { 1.0 };
        let [low, high] = p.ends();
        ParameterReport {
            name: p.name.clone(),
            given: *file.parameter_mut(&p.name).expect("checked"),
            value,
            standard_error: coordinate_error * by_coordinate,
            bounds: p.bounds,
            at_bound: coordinates[k] <= low || coordinates[k] >= high,
        }
    });
    let parameters = parameters.collect();
    form.fit = None;
    // nm/mm is urad.
    let tilt_urad = [0, 1].map(|k| rigid.get(1 + k).map_or(0.0, |b| b / points.half_mm));
    let at_middle = tilt_urad[0] * points.middle_mm[0] + tilt_urad[1] * points.middle_mm[1];
    let report = TargetReport {
        convention: "height along z less form, tilt and piston, nm; the lateral axes are projected along z",
        form,
        piston_nm: rigid[0] - at_middle,
        tilt_urad,
        parameters,
        rms_nm: rest.statistics().rms,
        steps,
    };
    Ok((rest, report))
}

/// Direction of the heights of a map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Heights {
    /// Along z, as all of Planish takes them.
    #[default]
    Z,
    /// Along the normal of the form.
    Normal,
}

/// Lateral axes of a map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Lateral {
    /// Projected along z, as all of Planish takes them.
    #[default]
    Projected,
    /// Along the surface, from the middle of the valid pixels.
    Surface,
}

/// Converts `map` to heights along z and projected lateral axes. `heights` and `lateral` state how the given map counts
/// them along the form. Pixels whose place on the surface is beyond the map become invalid. Refuses a form that does
/// not exist at a valid pixel of the result.
pub fn converted(
    map: &Surface,
    form: &Form,
    heights: Heights,
    lateral: Lateral,
) -> Result<Surface, Invalid> {
    let grid = *map.grid();
    let mut height_nm = map.height_nm().clone();
    if lateral == Lateral::Surface {
        let points = Points::valid(map);
        let development = Development::new(form, points.middle_mm, 2.0 * points.half_mm)?;
        let measured = Form::sampled(map)?;
        let (ny, nx) = grid.shape();
        let values = (0..ny * nx).into_par_iter().map(|i| {
            let uv =
                development.along([grid.x.coordinate_mm(i % nx), grid.y.coordinate_mm(i / nx)]);
            measured.sag_mm(uv).map_or(f64::NAN, |mm| NM_PER_MM * mm)
        });
        let values: Vec<f64> = values.collect();
        height_nm = Array2::from_shape_vec((ny, nx), values).expect("one value per pixel");
    }
    for ((r, c), z) in height_nm.indexed_iter_mut().filter(|(_, z)| !z.is_nan()) {
        let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
        let Some(point) = form.point([x, y]) else {
            let problem =
                format!("does not exist at ({x:.4}, {y:.4}) mm, where the map has {z} nm");
            let remedy = "give the form of the whole part, or a smaller clear aperture";
            return Err(Invalid::at_index("form", (r, c), problem, remedy));
        };
        if heights == Heights::Normal {
            // h_z = h_n / n_z
            *z /= point.cosine();
        }
    }
    Surface::new(grid, height_nm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use planish_types::{Axis, Grid};

    fn target(json: &str) -> Target {
        Target { file: serde_json::from_str(json).unwrap(), map: None }
    }

    fn grid() -> Grid {
        Grid { x: Axis::new(-20.0, 0.8, 51).unwrap(), y: Axis::new(-15.0, 0.75, 41).unwrap() }
    }

    /// Returns the heights of the form in `json`, nm, with a tilt, a piston, a hole and the addition `error(x, y)`, nm.
    fn measured(json: &str, error: impl Fn(f64, f64) -> f64) -> Surface {
        let form = Form::new(&target(json).file, None).unwrap();
        let grid = grid();
        let height = Array2::from_shape_fn(grid.shape(), |(r, c)| {
            let (x, y) = (grid.x.coordinate_mm(c), grid.y.coordinate_mm(r));
            let hole = (x - 4.0).hypot(y + 2.0) < 2.0;
            let nm = 1e6 * form.sag_mm([x, y]).unwrap() + 300.0 * x - 20.0 * y + 5000.0;
            if hole { f64::NAN } else { nm + error(x, y) }
        });
        Surface::new(grid, height).unwrap()
    }

    #[test]
    fn a_planted_form_is_found_from_a_bad_start() {
        let none = |_: f64, _: f64| 0.0;
        for (truth, start, tolerance) in [
            (
                r#"{"kind": "sphere", "radius_mm": 500}"#,
                r#"{"kind": "sphere", "radius_mm": 900, "fit": {"radius_mm": "free"}}"#,
                1e-9,
            ),
            (
                r#"{"kind": "asphere", "radius_mm": -80, "conic_constant": -0.6, "even_terms": [2e-7]}"#,
                r#"{"kind": "asphere", "radius_mm": -95, "conic_constant": 0, "even_terms": [0],
                    "fit": {"radius_mm": "free", "conic_constant": [-2, 1], "even_term_4": "free"}}"#,
                1e-5,
            ),
            (
                r#"{"kind": "elliptic-cylinder", "p_mm": 3000, "q_mm": 200, "theta_mrad": 20}"#,
                r#"{"kind": "elliptic-cylinder", "p_mm": 3000, "q_mm": 260, "theta_mrad": 23,
                    "fit": {"q_mm": "free", "theta_mrad": "free"}}"#,
                1e-6,
            ),
            (
                r#"{"kind": "hyperbolic-cylinder", "p_mm": 900, "q_mm": -300, "theta_mrad": 30}"#,
                r#"{"kind": "hyperbolic-cylinder", "p_mm": 900, "q_mm": -250, "theta_mrad": 30,
                    "fit": {"q_mm": "free"}}"#,
                1e-8,
            ),
        ] {
            let (rest, report) = without_target(&measured(truth, none), &target(start)).unwrap();
            // Heights of 1e6 nm carry roundings of 1e-10 each; the fit of a dozen steps adds two digits.
            assert!(rest.statistics().rms < 1e-6, "{start}: {report:?}");
            let mut want = target(truth).file;
            for p in &report.parameters {
                let want = *want.parameter_mut(&p.name).unwrap();
                assert!((p.value / want - 1.0).abs() < tolerance, "{} {}: {want}", p.name, p.value);
            }
            assert!((report.tilt_urad[0] - 300.0).abs() < 1e-3, "{report:?}");
        }
    }

    #[test]
    fn held_parameters_stay_and_bounds_hold() {
        let truth = measured(r#"{"kind": "sphere", "radius_mm": 500}"#, |_, _| 0.0);
        let given = target(r#"{"kind": "sphere", "radius_mm": 500}"#);
        let (rest, report) = without_target(&truth, &given).unwrap();
        // Heights of 1e6 nm, as above, with a plane alone to fit.
        assert!(rest.statistics().rms < 1e-7 && report.parameters.is_empty(), "{report:?}");
        let bounded =
            target(r#"{"kind": "sphere", "radius_mm": 600, "fit": {"radius_mm": [550, 700]}}"#);
        let (_, report) = without_target(&truth, &bounded).unwrap();
        let radius = &report.parameters[0];
        // The bound itself: rounding.
        assert!((radius.value - 550.0).abs() < 1e-9 && radius.at_bound, "{radius:?}");
        // A tilt that is held is left in the map.
        let held = target(r#"{"kind": "sphere", "radius_mm": 500, "fit": {"tilt": "held"}}"#);
        let (rest, _) = without_target(&truth, &held).unwrap();
        let plane = (300.0_f64.powi(2) * 140.0 + 400.0 * 77.0).sqrt();
        // A plane over the disk, whose edge pixels decide its moments.
        assert!((rest.statistics().rms / plane - 1.0).abs() < 0.1, "{}", rest.statistics().rms);
    }

    #[test]
    fn zernike_terms_are_fitted_by_their_names() {
        let circle = r#""centre_mm": [0, 0], "radius_mm": 25"#;
        for (numbering, astigmatism) in [("noll", "6"), ("fringe", "5"), ("ansi", "5")] {
            let norm = if numbering == "fringe" { 1.0 } else { 6.0_f64.sqrt() };
            let flat =
                measured(r#"{"kind": "plane"}"#, |x, y| norm * 40.0 * (x * x - y * y) / 625.0);
            let start = format!(
                r#"{{"kind": "plane", "zernike": {{"numbering": "{numbering}", {circle}, "terms_nm": {{"{astigmatism}": 0}}}},
                    "fit": {{"zernike_{astigmatism}_nm": "free"}}}}"#
            );
            let (rest, report) = without_target(&flat, &target(&start)).unwrap();
            // Below: rounding of heights of some 100 nm, and of the sums of the fit.
            assert!(rest.statistics().rms < 1e-8, "{report:?}");
            assert!((report.parameters[0].value - 40.0).abs() < 1e-9, "{report:?}");
        }
    }

    #[test]
    fn what_cannot_be_fitted_is_refused() {
        let flat = measured(r#"{"kind": "plane"}"#, |_, _| 0.0);
        let steep = without_target(&flat, &target(r#"{"kind": "sphere", "radius_mm": 15}"#));
        let message = steep.unwrap_err().to_string();
        assert!(
            message.contains("target[0, 0]: does not exist at (-20.0000, -15.0000) mm"),
            "{message}"
        );
        // On a plane the vertex of a sphere that is nearly one is a tilt.
        let shifted = target(
            r#"{"kind": "sphere", "radius_mm": 1e9, "vertex_mm": [0, 0], "fit": {"vertex_x_mm": "free"}}"#,
        );
        let message = without_target(&flat, &shifted).unwrap_err().to_string();
        assert!(message.contains("do not tell vertex_x_mm and the tilt apart"), "{message}");
    }

    #[test]
    fn heights_along_the_normal_and_arcs_are_converted_exactly() {
        let form = Form::sphere(40.0, [0.0; 2]).unwrap();
        let grid = grid();
        // 100 nm along the normal everywhere: 100 / cos(slope) along z.
        let map = Surface::new(grid, Array2::from_elem(grid.shape(), 100.0)).unwrap();
        let along_z = converted(&map, &form, Heights::Normal, Lateral::Projected).unwrap();
        for ((r, c), z) in along_z.height_nm().indexed_iter() {
            let sine = grid.x.coordinate_mm(c).hypot(grid.y.coordinate_mm(r)) / 40.0;
            // Rounding of 100 nm.
            assert!((z * (1.0 - sine * sine).sqrt() - 100.0).abs() < 1e-10);
        }
        // A height that is linear in the arc length along x, on a cylinder.
        let file: FormFile =
            serde_json::from_str(r#"{"kind": "cylinder", "radius_mm": 40}"#).unwrap();
        let cylinder = Form::new(&file, None).unwrap();
        let map = Array2::from_shape_fn(grid.shape(), |(_, c)| 3.0 * grid.x.coordinate_mm(c));
        let map = Surface::new(grid, map).unwrap();
        let flat = converted(&map, &cylinder, Heights::Z, Lateral::Surface).unwrap();
        for ((_, c), z) in flat.height_nm().indexed_iter().filter(|(_, z)| !z.is_nan()) {
            let arc = 40.0 * (grid.x.coordinate_mm(c) / 40.0).asin();
            // Arcs are quadratures that keep 1e-10 mm, of a slope of 3 nm / mm; the map is interpolated between samples
            // of a line.
            assert!((z - 3.0 * arc).abs() < 1e-8, "{z}");
        }
        // The arc of 20 mm is 20.94 mm: two columns at either end have no measurement.
        let valid = flat.height_nm().row(20).iter().filter(|z| !z.is_nan()).count();
        assert!((46..=49).contains(&valid), "{valid}");
    }
}
