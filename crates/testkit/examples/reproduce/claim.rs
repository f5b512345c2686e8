//! A claim of a paper, and the same number or statement as it is computed here.

/// Text in the place of the paper's number, if the paper has none.
const NOT_GIVEN: &str = "not given";

/// Comparison of the computed number with the paper's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    Agrees,
    Better,
    /// The computed number is smaller, but on another part or with another tool.
    Lower,
    Differs,
}

/// One row of a table.
pub struct Claim {
    what: String,
    paper: String,
    ours: String,
    ratio: Option<f64>,
    /// Largest relative difference from the paper's number that still agrees, where both sides are numbers.
    within: Option<f64>,
    found: Verdict,
    expected: Verdict,
    /// True if the row follows from the inputs alone, by a formula.
    is_arithmetic: bool,
    why: String,
}

impl Claim {
    /// A number with which the computed one agrees within `within`, relative.
    pub fn number(what: &str, unit: &str, paper: f64, ours: f64, within: f64) -> Self {
        let ratio = ours / paper;
        let digits = if within < 0.01 { 4 } else { 3 };
        let agrees = (ratio - 1.0).abs() <= within;
        Self {
            what: what.into(),
            paper: format!("{paper}{}{unit}", space(unit)),
            ours: format!("{}{}{unit}", significant(ours, digits), space(unit)),
            ratio: Some(ratio),
            within: Some(within),
            found: if agrees { Verdict::Agrees } else { Verdict::Differs },
            expected: Verdict::Agrees,
            is_arithmetic: false,
            why: String::new(),
        }
    }

    /// A number that follows from the inputs alone, by the formula that is named. Agreement shows that the
    /// formula is the paper's, and nothing about a method.
    pub fn arithmetic(
        what: &str,
        unit: &str,
        paper: f64,
        ours: f64,
        within: f64,
        formula: &str,
    ) -> Self {
        Self {
            is_arithmetic: true,
            why: formula.into(),
            ..Self::number(what, unit, paper, ours, within)
        }
    }

    /// A number that should be small, if the paper has another part or tool. The computed one agrees within
    /// `within`, relative; a smaller one is `Lower`, which compares no method.
    pub fn elsewhere(what: &str, unit: &str, paper: f64, ours: f64, within: f64) -> Self {
        let claim = Self::number(what, unit, paper, ours, within);
        if ours < paper * (1.0 - within) {
            return Self { found: Verdict::Lower, expected: Verdict::Lower, ..claim };
        }
        claim
    }

    /// A number that should be small, on the same part with the same tool; a smaller computed one is
    /// `Better`.
    pub fn small(what: &str, unit: &str, paper: f64, ours: f64, within: f64) -> Self {
        let mut claim = Self::number(what, unit, paper, ours, within);
        if ours < paper * (1.0 - within) {
            claim.found = Verdict::Better;
        }
        claim
    }

    /// A statement, which `holds` here or not.
    pub fn statement(what: &str, paper: &str, ours: String, holds: bool) -> Self {
        Self {
            what: what.into(),
            paper: paper.into(),
            ours,
            ratio: None,
            within: None,
            found: if holds { Verdict::Agrees } else { Verdict::Differs },
            expected: Verdict::Agrees,
            is_arithmetic: false,
            why: String::new(),
        }
    }

    /// A statement that the paper does not make, which `holds` here or not.
    pub fn check(what: &str, ours: String, holds: bool) -> Self {
        Self::statement(what, NOT_GIVEN, ours, holds)
    }

    /// The row follows from the inputs alone: `why` names the formula.
    pub fn by_arithmetic(self, why: &str) -> Self {
        Self { is_arithmetic: true, why: why.into(), ..self }
    }

    /// Expected to differ, because ...
    pub fn differs(self, why: impl Into<String>) -> Self {
        Self { expected: Verdict::Differs, why: why.into(), ..self }
    }

    /// Expected to be better, because ...
    pub fn better(self, why: impl Into<String>) -> Self {
        Self { expected: Verdict::Better, why: why.into(), ..self }
    }

    /// Expected to agree, with a remark.
    pub fn remark(self, why: impl Into<String>) -> Self {
        Self { why: why.into(), ..self }
    }

    /// Returns true if the verdict is the expected one.
    pub fn as_expected(&self) -> bool {
        self.found == self.expected
    }

    /// Returns true if the computed number or statement differs from that of the paper.
    pub fn is_different(&self) -> bool {
        self.found == Verdict::Differs
    }

    fn cells(&self) -> [String; 5] {
        let verdict = match (self.found, self.within) {
            (Verdict::Agrees, _) if self.paper == NOT_GIVEN => "holds".into(),
            (Verdict::Agrees, _) if self.is_arithmetic => "arithmetic".into(),
            (Verdict::Agrees, Some(within)) => {
                format!("agrees within {} %", trimmed(100.0 * within))
            }
            (Verdict::Agrees, None) => "agrees".into(),
            (Verdict::Better, _) => "better".into(),
            (Verdict::Lower, _) => "lower".into(),
            (Verdict::Differs, _) => String::from("differs"),
        };
        let remark = match (self.as_expected(), self.found, self.why.as_str()) {
            (false, ..) => format!("{verdict}; EXPECTED: {:?}", self.expected),
            (true, _, "") => verdict,
            (true, Verdict::Agrees, why) => format!("{verdict}; {why}"),
            (true, _, why) => format!("{verdict}: {why}"),
        };
        let ratio = self.ratio.map_or(String::new(), |r| significant(r, 3));
        [self.what.clone(), self.paper.clone(), self.ours.clone(), ratio, remark]
    }
}

/// Number of verdicts that are not the expected ones.
pub fn changed(claims: &[Claim]) -> usize {
    claims.iter().filter(|c| !c.as_expected()).count()
}

fn space(unit: &str) -> &'static str {
    if unit.is_empty() { "" } else { " " }
}

/// A percentage with at most two decimals, without trailing zeros.
fn trimmed(percent: f64) -> String {
    let text = format!("{percent:.2}");
    text.trim_end_matches('0').trim_end_matches('.').into()
}

/// `value` with `digits` significant digits.
pub fn significant(value: f64, digits: usize) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    // The exponent after rounding: 0.99996 has four digits as 1.000.
    let scientific = format!("{:.*e}", digits - 1, value);
    let exponent: i32 =
        scientific.split('e').nth(1).and_then(|e| e.parse().ok()).expect("it has an exponent");
    if !(-4..=6).contains(&exponent) {
        return scientific;
    }
    let decimals = (digits as i32 - 1 - exponent).max(0) as usize;
    format!("{value:.decimals$}")
}

/// Columns of the tables.
const COLUMNS: [&str; 5] = ["claim", "paper", "ours", "ratio", "verdict"];

/// The claims as a table in Markdown.
pub fn table<'a>(claims: impl IntoIterator<Item = &'a Claim>) -> String {
    let mut text = format!("| {} |\n|---|---|---|---|---|\n", COLUMNS.join(" | "));
    for claim in claims {
        text.push_str(&format!("| {} |\n", claim.cells().join(" | ")));
    }
    text
}

/// The claims as a CSV file.
pub fn comma_separated(claims: &[Claim]) -> String {
    let mut text = COLUMNS.join(",") + "\n";
    for claim in claims {
        let quoted = claim.cells().map(|cell| format!("\"{}\"", cell.replace('"', "\"\"")));
        text.push_str(&(quoted.join(",") + "\n"));
    }
    text
}
