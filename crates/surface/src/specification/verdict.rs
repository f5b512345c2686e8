//! Verdicts: limit by limit, and on the whole specification.

use planish_types::text::significant;
use serde::Serialize;

/// What a specification says of a mirror.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SpecificationReport {
    /// Name of the specification.
    pub name: String,
    /// Whether every limit is kept.
    pub passed: bool,
    /// The verdict on each limit, in the order of the file.
    pub limits: Vec<LimitReport>,
}

/// The measured value of a limited quantity, and the verdict on it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LimitReport {
    /// The quantity in words.
    pub quantity: String,
    /// Unit of the value and the limit.
    pub unit: &'static str,
    /// Measured value; `null` for infinity (the radius of a plane).
    pub value: f64,
    /// Largest or smallest allowed value.
    pub limit: f64,
    /// Whether `limit` is the largest or the smallest allowed value.
    pub bound: Bound,
    /// Whether the limit is kept.
    pub passed: bool,
    /// Where the mirror is worst, in words; `null` where the quantity has no place.
    pub worst: Option<String>,
}

/// Which side of a limit is allowed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Bound {
    /// At most the limit.
    AtMost,
    /// At least the limit.
    AtLeast,
}

impl LimitReport {
    /// The verdict on `value`.
    pub(super) fn new(
        quantity: String,
        unit: &'static str,
        value: f64,
        bound: Bound,
        limit: f64,
    ) -> Self {
        let passed = match bound {
            Bound::AtMost => value <= limit,
            Bound::AtLeast => value >= limit,
        };
        Self { quantity, unit, value, limit, bound, passed, worst: None }
    }

    /// The same, with the place where the mirror is worst.
    pub(super) fn worst_at(self, worst: String) -> Self {
        Self { worst: Some(worst), ..self }
    }

    /// The verdict as a sentence without a full stop.
    pub fn text(&self) -> String {
        let Self { quantity, unit, bound, worst, .. } = self;
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        let [value, limit] = [self.value, self.limit].map(|v| significant(v, 4));
        let allowed = match bound {
            Bound::AtMost => "at most",
            Bound::AtLeast => "at least",
        };
        let percent = significant(100.0 * (self.value / self.limit - 1.0).abs(), 3);
        let verdict = match (self.passed, bound) {
            (true, _) => String::new(),
            (false, Bound::AtMost) => format!(", {percent} % too much"),
            (false, Bound::AtLeast) => format!(", {percent} % too little"),
        };
        let place = worst.as_ref().map_or(String::new(), |w| format!("; worst {w}"));
        format!("{quantity}: {value}{unit}, {allowed} {limit}{unit}{verdict}{place}")
    }
}

impl SpecificationReport {
    /// What fails, by how much and where; `None` where everything is kept.
    pub fn failures(&self) -> Option<String> {
        let failed: Vec<String> =
            self.limits.iter().filter(|l| !l.passed).map(LimitReport::text).collect();
        (!failed.is_empty()).then(|| {
            let (n, all) = (failed.len(), self.limits.len());
            format!("{n} of {all} limits of {} are exceeded: {}", self.name, failed.join("; "))
        })
    }
}
