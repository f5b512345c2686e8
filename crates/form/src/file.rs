//! The form file: one JSON object that describes the form of a part. A key that its kind does not use is refused.

use std::collections::BTreeMap;

use planish_types::{Invalid, is_plausible_mm};
use serde::{Deserialize, Serialize};

use crate::{ImagingConic, zernike::Numbering};

/// Largest magnitude of a radius or a distance, mm; beyond it a form is a plane in all but name. Larger: sums lose
/// digits.
const LARGEST_RADIUS_MM: f64 = 1e12;

/// Kind of a form. It determines which keys of the file apply.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FormKind {
    /// A plane.
    Plane,
    /// A sphere of `radius_mm`.
    Sphere,
    /// A conic of revolution of `radius_mm` and `conic_constant`.
    Conic,
    /// A paraboloid of `radius_mm`: the conic with the constant -1.
    Paraboloid,
    /// A conic of revolution with the additional `even_terms`.
    Asphere,
    /// A cylinder that is curved along its x, of `radius_mm`, with a conic constant and even terms on request.
    Cylinder,
    /// A circle of `radius_y_mm` over y, turned about an axis along y at the distance `radius_x_mm`.
    Toroid,
    /// A cylinder that images a source onto a point.
    EllipticCylinder,
    /// A cylinder that focuses or collimates: one of `p_mm` and `q_mm` is infinite and left out.
    ParabolicCylinder,
    /// A cylinder one of whose points is virtual: one of `p_mm` and `q_mm` is negative.
    HyperbolicCylinder,
    /// A map of heights, a surface artifact.
    Map,
}

/// Axis along which the heights of an off-axis section of a parent form count.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Axis {
    /// Along the axis of the parent.
    Parent,
    /// Along the normal of the parent in the middle of the section.
    Normal,
}

/// Rule by which a fit may change a parameter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ParameterFit {
    /// Freedom as a word: `"free"` or `"held"`.
    Word(FitWord),
    /// Smallest and largest value, in the unit of the parameter.
    Between([f64; 2]),
}

/// Rule for a parameter without bounds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FitWord {
    /// Fitted without bounds.
    Free,
    /// Kept at its value in the file.
    Held,
}

/// Zernike terms that are added to a form.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ZernikeFile {
    /// Numbering and normalisation of the terms.
    pub numbering: Numbering,
    /// Centre of the unit circle on the part [x, y], mm.
    pub centre_mm: [f64; 2],
    /// Radius of the unit circle, mm.
    pub radius_mm: f64,
    /// Coefficients, nm, by the index of the term as text.
    pub terms_nm: BTreeMap<String, f64>,
}

impl ZernikeFile {
    /// Returns the index and the coefficient, nm, of each term.
    pub(crate) fn indexed(&self) -> impl Iterator<Item = (u32, f64)> {
        self.terms_nm.iter().filter_map(|(index, nm)| Some((index.parse().ok()?, *nm)))
    }
}

/// Content of a form file as it is written, not checked yet.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FormFile {
    /// Kind of the form.
    pub kind: FormKind,
    /// Radius of curvature at the vertex, mm; positive where the part is concave.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub radius_mm: Option<f64>,
    /// Radius of curvature of a toroid at its vertex along x, mm; positive where the part is concave.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub radius_x_mm: Option<f64>,
    /// Radius of curvature of a toroid at its vertex along y, mm; positive where the part is concave.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub radius_y_mm: Option<f64>,
    /// Conic constant k, dimensionless; 0 is a sphere, -1 a parabola.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub conic_constant: Option<f64>,
    /// Coefficients A4, A6, ... of ISO 10110-12, mm^-3, mm^-5, ...
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub even_terms: Option<Vec<f64>>,
    /// Distance from source to pole, mm; negative for a virtual source.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub p_mm: Option<f64>,
    /// Distance from pole to image, mm; negative for a virtual image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub q_mm: Option<f64>,
    /// Grazing angle at the pole, mrad.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub theta_mrad: Option<f64>,
    /// Directory of the map (a surface artifact), relative to the file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub surface: Option<String>,
    /// Position of the vertex, or of the middle of an off-axis section, on the part [x, y], mm; the origin if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vertex_mm: Option<[f64; 2]>,
    /// Angle by which the axes of the form are turned against the part, from x towards y, degrees; 0 if absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_deg: Option<f64>,
    /// Middle of the off-axis section [x, y], mm, from the vertex of the parent along the axes of the form. Absent for
    /// a form about its vertex.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub off_axis_mm: Option<[f64; 2]>,
    /// Axis along which the heights of an off-axis section count; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height_along: Option<Axis>,
    /// Zernike terms that are added to the height.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub zernike: Option<ZernikeFile>,
    /// Parameters that a fit may change, by their names; all others keep their values.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fit: Option<BTreeMap<String, ParameterFit>>,
}

impl FormFile {
    /// Returns the file of a plane, with every optional key absent.
    pub fn plane() -> Self {
        Self {
            kind: FormKind::Plane,
            radius_mm: None,
            radius_x_mm: None,
            radius_y_mm: None,
            conic_constant: None,
            even_terms: None,
            p_mm: None,
            q_mm: None,
            theta_mrad: None,
            surface: None,
            vertex_mm: None,
            rotation_deg: None,
            off_axis_mm: None,
            height_along: None,
            zernike: None,
            fit: None,
        }
    }

    /// Refuses keys that the kind does not use, missing keys, and numbers out of their range.
    pub fn check(&self) -> Result<(), Invalid> {
        use FormKind::{
            Asphere, Conic, Cylinder, EllipticCylinder, HyperbolicCylinder, Map, ParabolicCylinder,
            Paraboloid, Plane, Sphere, Toroid,
        };
        let kind = self.kind;
        let named = serde_name(kind);
        let imaging = matches!(kind, EllipticCylinder | ParabolicCylinder | HyperbolicCylinder);
        let revolves = matches!(kind, Sphere | Conic | Paraboloid | Asphere);
        let has_radius = revolves || kind == Cylinder;
        let needed = |needs: bool| if needs { Some(true) } else { None };
        let optional = |allowed: bool| if allowed { Some(false) } else { None };
        // Key, whether it is there, whether the kind needs it (true), may have it (false), or not (None).
        let keys: [(&'static str, bool, Option<bool>); 11] = [
            ("radius_mm", self.radius_mm.is_some(), needed(has_radius)),
            ("radius_x_mm", self.radius_x_mm.is_some(), needed(kind == Toroid)),
            ("radius_y_mm", self.radius_y_mm.is_some(), needed(kind == Toroid)),
            (
                "conic_constant",
                self.conic_constant.is_some(),
                match kind {
                    Conic => Some(true),
                    _ => optional(matches!(kind, Asphere | Cylinder)),
                },
            ),
            (
                "even_terms",
                self.even_terms.is_some(),
                if kind == Asphere { Some(true) } else { optional(kind == Cylinder) },
            ),
            (
                "p_mm",
                self.p_mm.is_some(),
                if kind == ParabolicCylinder { Some(false) } else { needed(imaging) },
            ),
            (
                "q_mm",
                self.q_mm.is_some(),
                if kind == ParabolicCylinder { Some(false) } else { needed(imaging) },
            ),
            ("theta_mrad", self.theta_mrad.is_some(), needed(imaging)),
            ("surface", self.surface.is_some(), needed(kind == Map)),
            ("off_axis_mm", self.off_axis_mm.is_some(), optional(!matches!(kind, Plane | Map))),
            ("height_along", self.height_along.is_some(), optional(self.off_axis_mm.is_some())),
        ];
        for (key, there, use_of) in keys {
            match (there, use_of) {
                (true, None) => {
                    let problem = format!("is given, but a form of the kind {named} has none");
                    return Err(Invalid::whole(key, problem, "leave it out, or give another kind"));
                }
                (false, Some(true)) => {
                    let problem = format!("is missing in a form of the kind {named}");
                    return Err(Invalid::whole(key, problem, "add it (docs/forms.md)"));
                }
                _ => {}
            }
        }
        self.check_numbers()?;
        if imaging {
            self.imaging()?;
        }
        self.check_zernike()?;
        self.check_fit()
    }

    /// Refuses numbers that are not finite, zero or beyond their range where the form needs others.
    fn check_numbers(&self) -> Result<(), Invalid> {
        let radii = [
            ("radius_mm", self.radius_mm),
            ("radius_x_mm", self.radius_x_mm),
            ("radius_y_mm", self.radius_y_mm),
        ];
        for (key, radius) in radii {
            let Some(radius) = radius else { continue };
            if radius == 0.0 || radius.is_nan() || radius.abs() > LARGEST_RADIUS_MM {
                let remedy = "give the radius of curvature in mm, not 0, at most 1e12";
                return Err(Invalid::whole(key, format!("is {radius}"), remedy));
            }
        }
        let numbers = [
            ("conic_constant", self.conic_constant, 1e6),
            ("p_mm", self.p_mm, LARGEST_RADIUS_MM),
            ("q_mm", self.q_mm, LARGEST_RADIUS_MM),
            ("rotation_deg", self.rotation_deg, 360.0),
        ];
        for (key, value, most) in numbers {
            if let Some(v) = value.filter(|v| v.is_nan() || v.abs() > most) {
                let remedy = format!("give a number of a magnitude of at most {most:e}");
                return Err(Invalid::whole(key, format!("is {v}"), remedy));
            }
        }
        for (key, place) in [("vertex_mm", self.vertex_mm), ("off_axis_mm", self.off_axis_mm)] {
            let Some(place) = place else { continue };
            if let Some(i) = place.iter().position(|v| !is_plausible_mm(*v)) {
                let problem = format!("is {}", place[i]);
                return Err(Invalid::at_index(
                    key,
                    i,
                    problem,
                    "give a place in mm, within 1e7 mm",
                ));
            }
        }
        if let Some(terms) = &self.even_terms
            && let Some(i) = terms.iter().position(|v| !v.is_finite())
        {
            let problem = format!("is {}", terms[i]);
            return Err(Invalid::at_index(
                "even_terms",
                i,
                problem,
                "give finite numbers: A4, A6, ...",
            ));
        }
        Ok(())
    }

    fn check_zernike(&self) -> Result<(), Invalid> {
        let Some(zernike) = &self.zernike else { return Ok(()) };
        if !(zernike.radius_mm > 0.0 && is_plausible_mm(zernike.radius_mm)) {
            let problem = format!("has radius_mm {}", zernike.radius_mm);
            return Err(Invalid::whole(
                "zernike",
                problem,
                "give the radius of the unit circle in mm",
            ));
        }
        if zernike.centre_mm.iter().any(|v| !is_plausible_mm(*v)) {
            let problem = format!("has centre_mm {:?}", zernike.centre_mm);
            return Err(Invalid::whole("zernike", problem, "give a place in mm, within 1e7 mm"));
        }
        for (index, nm) in &zernike.terms_nm {
            let Ok(number) = index.parse() else {
                let problem = format!("has the term {index:?}");
                return Err(Invalid::whole("zernike", problem, "give its number, such as \"5\""));
            };
            zernike.numbering.order(number)?;
            if !nm.is_finite() {
                let problem = format!("has {nm} nm of the term {index}");
                return Err(Invalid::whole("zernike", problem, "give finite nm"));
            }
        }
        Ok(())
    }

    fn check_fit(&self) -> Result<(), Invalid> {
        let mut copy = self.clone();
        for (name, freedom) in self.fit.iter().flatten() {
            if name == "tilt" {
                if matches!(freedom, ParameterFit::Between(_)) {
                    let remedy = "give \"free\" or \"held\"";
                    return Err(Invalid::whole("fit", "bounds the tilt", remedy));
                }
                continue;
            }
            let Some(value) = copy.parameter_mut(name) else {
                let known = self.parameter_names().join(", ");
                let problem = format!("names {name:?}, which this form does not have");
                return Err(Invalid::whole("fit", problem, format!("give any of tilt, {known}")));
            };
            if let ParameterFit::Between([low, high]) = freedom
                && !(low < high && (low..=high).contains(&&*value))
            {
                let problem = format!("bounds {name} to [{low}, {high}], and it is {value}");
                let remedy = "give the smallest and the largest value, with the stated one between";
                return Err(Invalid::whole("fit", problem, remedy));
            }
        }
        Ok(())
    }

    /// Returns the curve of an elliptic, parabolic or hyperbolic cylinder. Refuses distances and angles with which
    /// there is no mirror.
    pub(crate) fn imaging(&self) -> Result<ImagingConic, Invalid> {
        let far = f64::INFINITY;
        let [p, q] = [self.p_mm, self.q_mm].map(|mm| mm.unwrap_or(far));
        let theta = 1e-3 * self.theta_mrad.unwrap_or(f64::NAN);
        match self.kind {
            FormKind::HyperbolicCylinder => ImagingConic::hyperbola(p, q, theta),
            FormKind::ParabolicCylinder => ImagingConic::parabola(p, q, theta),
            _ => ImagingConic::ellipse(p, q, theta),
        }
    }

    /// Returns the names of the numbers that a fit may change. Positions are among them only if the file states them.
    pub fn parameter_names(&self) -> Vec<String> {
        let words = [
            ("radius_mm", self.radius_mm.is_some()),
            ("radius_x_mm", self.radius_x_mm.is_some()),
            ("radius_y_mm", self.radius_y_mm.is_some()),
            ("conic_constant", self.conic_constant.is_some()),
            ("p_mm", self.p_mm.is_some()),
            ("q_mm", self.q_mm.is_some()),
            ("theta_mrad", self.theta_mrad.is_some()),
            ("vertex_x_mm", self.vertex_mm.is_some()),
            ("vertex_y_mm", self.vertex_mm.is_some()),
            ("rotation_deg", self.rotation_deg.is_some()),
            ("off_axis_x_mm", self.off_axis_mm.is_some()),
            ("off_axis_y_mm", self.off_axis_mm.is_some()),
        ];
        let words = words.into_iter().filter(|w| w.1).map(|w| w.0.to_string());
        let even = (0..self.even_terms.as_ref().map_or(0, Vec::len))
            .map(|i| format!("even_term_{}", 2 * i + 4));
        let zernike = self.zernike.iter().flat_map(|z| z.terms_nm.keys());
        words.chain(even).chain(zernike.map(|index| format!("zernike_{index}_nm"))).collect()
    }

    /// Returns the number of the parameter `name`, to read or change it, or `None` if the file does not state it.
    pub fn parameter_mut(&mut self, name: &str) -> Option<&mut f64> {
        match name {
            "radius_mm" => self.radius_mm.as_mut(),
            "radius_x_mm" => self.radius_x_mm.as_mut(),
            "radius_y_mm" => self.radius_y_mm.as_mut(),
            "conic_constant" => self.conic_constant.as_mut(),
            "p_mm" => self.p_mm.as_mut(),
            "q_mm" => self.q_mm.as_mut(),
            "theta_mrad" => self.theta_mrad.as_mut(),
            "vertex_x_mm" => self.vertex_mm.as_mut().map(|v| &mut v[0]),
            "vertex_y_mm" => self.vertex_mm.as_mut().map(|v| &mut v[1]),
            "rotation_deg" => self.rotation_deg.as_mut(),
            "off_axis_x_mm" => self.off_axis_mm.as_mut().map(|v| &mut v[0]),
            "off_axis_y_mm" => self.off_axis_mm.as_mut().map(|v| &mut v[1]),
            _ => {
                if let Some(index) =
                    name.strip_prefix("zernike_").and_then(|n| n.strip_suffix("_nm"))
                {
                    return self.zernike.as_mut()?.terms_nm.get_mut(index);
                }
                let power: usize = name.strip_prefix("even_term_")?.parse().ok()?;
                let index = power.checked_sub(4).filter(|p| p % 2 == 0)? / 2;
                self.even_terms.as_mut()?.get_mut(index)
            }
        }
    }
}

/// Returns the name of a kind as the file states it.
fn serde_name(kind: FormKind) -> &'static str {
    match kind {
        FormKind::Plane => "plane",
        FormKind::Sphere => "sphere",
        FormKind::Conic => "conic",
        FormKind::Paraboloid => "paraboloid",
        FormKind::Asphere => "asphere",
        FormKind::Cylinder => "cylinder",
        FormKind::Toroid => "toroid",
        FormKind::EllipticCylinder => "elliptic-cylinder",
        FormKind::ParabolicCylinder => "parabolic-cylinder",
        FormKind::HyperbolicCylinder => "hyperbolic-cylinder",
        FormKind::Map => "map",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn problem(json: &str) -> String {
        match serde_json::from_str::<FormFile>(json) {
            Err(e) => e.to_string(),
            Ok(file) => file.check().unwrap_err().to_string(),
        }
    }

    #[test]
    fn what_is_no_form_is_refused_with_its_key() {
        for (json, part) in [
            (r#"{"kind": "sphere"}"#, "radius_mm: is missing in a form of the kind sphere"),
            (r#"{"kind": "sphere", "radius_mm": 0}"#, "radius_mm: is 0"),
            (r#"{"kind": "sphere", "radius_mm": 9, "conic_constant": 1}"#, "has none"),
            (r#"{"kind": "sphere", "radius": 9}"#, "unknown field `radius`"),
            (
                r#"{"kind": "toroid", "radius_x_mm": 9}"#,
                "radius_y_mm: is missing in a form of the kind toroid",
            ),
            (r#"{"kind": "toroid", "radius_x_mm": 9, "radius_y_mm": 0}"#, "radius_y_mm: is 0"),
            (r#"{"kind": "toroid", "radius_mm": 9}"#, "radius_mm: is given"),
            (r#"{"kind": "plane", "off_axis_mm": [1, 2]}"#, "off_axis_mm: is given"),
            (
                r#"{"kind": "elliptic-cylinder", "p_mm": 9, "q_mm": -1, "theta_mrad": 3}"#,
                "q is -1 mm",
            ),
            (r#"{"kind": "asphere", "radius_mm": 9}"#, "even_terms: is missing"),
            (
                r#"{"kind": "sphere", "radius_mm": 9, "vertex_mm": [1e9, 0]}"#,
                "vertex_mm[0]: is 1000000000",
            ),
            (
                r#"{"kind": "sphere", "radius_mm": 9, "fit": {"p_mm": "free"}}"#,
                "give any of tilt, radius_mm",
            ),
            (
                r#"{"kind": "sphere", "radius_mm": 9, "fit": {"radius_mm": [10, 12]}}"#,
                "bounds radius_mm",
            ),
            (
                r#"{"kind": "plane", "zernike": {"numbering": "noll", "centre_mm": [0, 0], "radius_mm": 1,
                    "terms_nm": {"0": 1}}}"#,
                "has the term 0",
            ),
        ] {
            let message = problem(json);
            assert!(message.contains(part), "{json}: {message}");
        }
    }

    #[test]
    fn parameters_are_found_by_name() {
        let json = r#"{"kind": "asphere", "radius_mm": 9, "even_terms": [1, 2], "vertex_mm": [3, 4],
            "zernike": {"numbering": "ansi", "centre_mm": [0, 0], "radius_mm": 1, "terms_nm": {"12": 7}}}"#;
        let mut file: FormFile = serde_json::from_str(json).unwrap();
        let names = file.parameter_names();
        let values: Vec<f64> = names.iter().map(|n| *file.parameter_mut(n).unwrap()).collect();
        assert_eq!(
            names,
            [
                "radius_mm",
                "vertex_x_mm",
                "vertex_y_mm",
                "even_term_4",
                "even_term_6",
                "zernike_12_nm"
            ]
        );
        assert_eq!(values, [9.0, 3.0, 4.0, 1.0, 2.0, 7.0]);
        assert!(file.parameter_mut("even_term_5").is_none());
    }
}
