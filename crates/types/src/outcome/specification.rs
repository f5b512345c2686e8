//! Verdict of `planish surface spec`: limit by limit, and on the whole specification.

use serde::{Deserialize, Serialize};

use super::NoMore;
use crate::text::significant;

/// Outcome of `planish surface spec`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpecificationOutcome<More = NoMore> {
    /// Further numbers.
    #[serde(flatten)]
    pub more: More,
    /// The verdict; `null` of a map that was measured without a specification.
    pub specification: Option<SpecificationReport>,
}

/// Verdict of a specification on a mirror.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpecificationReport {
    /// Name of the specification.
    #[serde(default)]
    pub name: String,
    /// True if every limit is kept.
    pub passed: bool,
    /// The verdict on each limit, in the order of the file.
    #[serde(default)]
    pub limits: Vec<LimitReport>,
}

/// The measured value of a limited quantity, and the verdict on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LimitReport {
    /// The quantity in words.
    pub quantity: String,
    /// Unit of the value and the limit.
    pub unit: String,
    /// Measured value; `null` for infinity (the radius of a plane).
    #[serde(deserialize_with = "super::null_is_infinity")]
    pub value: f64,
    /// Largest or smallest allowed value.
    pub limit: f64,
    /// Kind of the limit: largest or smallest allowed value.
    pub bound: Bound,
    /// True if the limit is kept.
    pub passed: bool,
    /// Place where the mirror is worst, in words; `null` if the quantity has no place.
    pub worst: Option<String>,
    /// The part of noise in the value; absent if the noise is not known, or the part cannot be computed for
    /// the quantity.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<NoisePart>,
}

/// The part of white noise in a measured value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoisePart {
    /// The value that noise alone would have; of a largest value an upper bound.
    pub of_noise: f64,
    /// The value without the noise; of a largest value a lower bound.
    pub without_noise: f64,
    /// True if the limit lies between the value and the value without the noise.
    pub decides: bool,
}

/// Verdict on a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The value keeps the limit.
    Kept,
    /// The value breaks the limit, without the noise too.
    Broken,
    /// The value breaks the limit, and without the noise keeps it.
    NoiseDecides,
}

/// Rule by which the part of noise is subtracted from a value.
#[derive(Clone, Copy, Debug)]
pub enum Subtraction {
    /// sqrt(value^2 - part^2), of an RMS.
    OfSquares,
    /// value - part, of a density or a largest value.
    Linear,
}

/// Allowed side of a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Bound {
    /// Values up to the limit are allowed.
    AtMost,
    /// Values from the limit on are allowed.
    AtLeast,
}

impl LimitReport {
    /// Returns the verdict on a measured quantity: `value` against `limit`, both in `unit`.
    pub fn new(quantity: String, unit: &str, value: f64, bound: Bound, limit: f64) -> Self {
        let passed = match bound {
            Bound::AtMost => value <= limit,
            Bound::AtLeast => value >= limit,
        };
        Self { quantity, unit: unit.into(), value, limit, bound, passed, worst: None, noise: None }
    }

    /// Returns this report with `worst`, the position or frequency at which the mirror is worst, in words.
    pub fn worst_at(self, worst: String) -> Self {
        Self { worst: Some(worst), ..self }
    }

    /// Returns this report with `of_noise`, the value that noise alone would have, and the value without the noise.
    /// `how` states whether squares or the values themselves are subtracted.
    pub fn beside_noise(self, of_noise: f64, how: Subtraction) -> Self {
        let without_noise = match how {
            Subtraction::OfSquares => (self.value.powi(2) - of_noise.powi(2)).max(0.0).sqrt(),
            Subtraction::Linear => (self.value - of_noise).max(0.0),
        };
        self.with_and_without_noise(of_noise, without_noise)
    }

    /// Returns this report with the value that noise alone would have, the value without the noise, and whether the
    /// noise decides.
    pub fn with_and_without_noise(mut self, of_noise: f64, without_noise: f64) -> Self {
        let would_pass = match self.bound {
            Bound::AtMost => without_noise <= self.limit,
            Bound::AtLeast => without_noise >= self.limit,
        };
        let decides = !self.passed && would_pass;
        self.noise = Some(NoisePart { of_noise, without_noise, decides });
        self
    }

    /// Returns the verdict: kept, broken, or broken only because of the noise.
    pub fn verdict(&self) -> Verdict {
        match self.noise {
            _ if self.passed => Verdict::Kept,
            Some(noise) if noise.decides => Verdict::NoiseDecides,
            _ => Verdict::Broken,
        }
    }

    /// Returns the quantity, its value, the limit and the verdict in words, without a full stop.
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
        let noise = self.noise.map_or(String::new(), |n| {
            let [of, without] = [n.of_noise, n.without_noise].map(|v| significant(v, 4));
            let decides = if n.decides { ": noise decides" } else { "" };
            format!(" (noise alone {of}{unit}, without noise {without}{unit}{decides})")
        });
        let place = worst.as_ref().map_or(String::new(), |w| format!("; worst {w}"));
        format!("{quantity}: {value}{unit}, {allowed} {limit}{unit}{verdict}{noise}{place}")
    }
}

impl SpecificationReport {
    /// Returns the limits that are not kept, by how much and where, in words; `None` if all of them are kept.
    pub fn failures(&self) -> Option<String> {
        let mut sentences = Vec::new();
        for (verdict, how) in [
            (Verdict::Broken, "are exceeded"),
            (Verdict::NoiseDecides, "are exceeded because of the noise"),
        ] {
            let failed = self.limits.iter().filter(|l| l.verdict() == verdict);
            let failed: Vec<String> = failed.map(LimitReport::text).collect();
            if !failed.is_empty() {
                let [n, all] = [failed.len(), self.limits.len()];
                let name = &self.name;
                sentences
                    .push(format!("{n} of {all} limits of {name} {how}: {}", failed.join("; ")));
            }
        }
        if sentences.is_empty() { None } else { Some(sentences.join("; ")) }
    }
}
