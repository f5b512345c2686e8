//! A plan of several tools: its tools in the order in which they run, the subsets of the rack from which they were
//! chosen, and the other plans of the rack that were executed.

use std::collections::BTreeSet;

use planish_types::text::significant;
use serde::{Deserialize, Serialize};

/// Ratio of the executed residual to the planned one above which a warning says so. Larger: plans that the motion
/// cannot follow pass in silence. Smaller: warnings about usual differences. Chosen: the goal for a motion, 5 %.
const WORSE_FROM: f64 = 1.05;

/// Ratio of the time of the motions to that of the dwell times above which a warning says so. Larger: runs that take
/// much longer than the choice pass in silence. Smaller: every turn of a raster gets a warning. Chosen.
const LONGER_FROM: f64 = 1.5;

/// Part of the residual, in RMS, from which a warning says that no tool corrects its waves. Larger: a rack without a
/// narrow tool passes in silence. Smaller: warnings about noise. At half, these waves are a quarter of the mean square.
const SHORT_PART: f64 = 0.5;

/// A plan of several tools.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Several {
    /// Tools in the order in which they run.
    pub tools: Vec<ToolOfPlan>,
    /// Time of all motions and changes, s.
    pub total_time_s: f64,
    /// Cost of the plan as executed: half the mean square of the residual, and the price of its time and changes, nm^2.
    pub cost_nm2: f64,
    /// Number of tools of the rack.
    pub rack_size: usize,
    /// Subsets of the rack that the choice looked at, in its order; empty if the tools were not chosen.
    pub subsets: Vec<Subset>,
    /// Bound of the excess of the cost of the choice over that of the best subset, relative to it; `null` if nothing
    /// is proven.
    pub relative_gap_of_choice: Option<f64>,
    /// Other plans of the rack, executed; empty if the run has none.
    pub others: Vec<OtherExecuted>,
    /// Sentences on what remains or differs from the choice.
    pub warnings: Vec<String>,
}

/// A tool of the plan, as it runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ToolOfPlan {
    /// Name of the tool.
    pub name: String,
    /// Diameter of the circle with the area of the TIF at or above half its peak, mm.
    pub width_mm: f64,
    /// RMS of the map before this tool, nm.
    pub before_rms_nm: f64,
    /// Mean of what the tool removes over the valid pixels, nm.
    pub mean_removal_nm: f64,
    /// RMS that the dwell times of this tool and of those after it leave, nm; `null` if it is not known.
    pub planned_rms_nm: Option<f64>,
    /// RMS of the map after the executed motion of this tool, nm.
    pub rms_nm: f64,
    /// Time of its motion, s.
    pub time_s: f64,
    /// Time to mount it, s.
    pub change_s: f64,
    /// Time of the run until it is ready, with all changes, s.
    pub elapsed_s: f64,
    /// Largest speed of its motion along [x, y], mm/s.
    pub max_velocity_mm_per_s: [f64; 2],
    /// True if the verdict found every limit of its machine kept.
    pub limits_kept: bool,
    /// Name of its machine; `null` if it is not known.
    pub machine: Option<String>,
    /// Path of its program from the page; `null` without one.
    pub program: Option<String>,
}

/// A subset of the rack with its dwell times alone, without a motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Subset {
    /// Names of its tools.
    pub tools: Vec<String>,
    /// RMS that its dwell times leave, nm.
    pub rms_nm: f64,
    /// Sum of the dwell times of each tool, s.
    pub time_s: Vec<f64>,
    /// Sum of all dwell times and changes, s.
    pub time_with_changes_s: f64,
    /// Cost by which the subsets are compared, nm^2.
    pub cost_nm2: f64,
    /// True if the plan runs these tools.
    pub is_chosen: bool,
}

/// Another plan of the rack, executed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OtherExecuted {
    /// Name of its directory in `others` of the run.
    pub label: String,
    /// Names of its tools in the order in which they run.
    pub tools: Vec<String>,
    /// Factor on the prices of the rack with which it was planned.
    pub price_factor: f64,
    /// RMS of the map after its last motion, nm.
    pub rms_nm: f64,
    /// Time of the motion of each tool, s.
    pub time_s: Vec<f64>,
    /// Time of all motions and changes, s.
    pub time_with_changes_s: f64,
    /// Its cost at the prices of the rack, nm^2.
    pub cost_nm2: f64,
    /// True if the verdicts found every limit kept.
    pub limits_kept: bool,
    /// Path of its report from the page.
    pub report: String,
}

impl OtherExecuted {
    /// Returns the plan in words, such as `beam-40 + beam-10, prices x 0.3`.
    pub fn words(&self) -> String {
        let tools = self.tools.join(" + ");
        if self.price_factor == 1.0 {
            tools
        } else {
            format!("{tools}, prices x {}", self.price_factor)
        }
    }
}

/// Waves of the last residual that no tool of the plan corrects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WavesLeft {
    /// Longest period of these waves along [x, y], mm; `None` along an axis without such waves.
    pub period_mm: [Option<f64>; 2],
    /// RMS of these waves after the last tool, nm.
    pub rms_nm: f64,
}

impl Several {
    /// Returns the names of the tools in the order in which they run, such as `beam-40, then beam-10`.
    pub fn order(&self) -> String {
        let names: Vec<&str> = self.tools.iter().map(|tool| tool.name.as_str()).collect();
        names.join(", then ")
    }

    /// Returns true if every motion keeps the limits of its machine.
    pub fn keeps_limits(&self) -> bool {
        self.tools.iter().all(|tool| tool.limits_kept)
    }

    /// Returns the subset that the plan runs; `None` if the tools were not chosen.
    pub fn chosen(&self) -> Option<&Subset> {
        self.subsets.iter().find(|subset| subset.is_chosen)
    }

    /// Returns the other executed plan within the limits that costs least; `None` without one.
    fn least_of_others(&self) -> Option<&OtherExecuted> {
        let kept = self.others.iter().filter(|other| other.limits_kept);
        kept.min_by(|a, b| a.cost_nm2.total_cmp(&b.cost_nm2))
    }

    /// Returns a sentence that this plan costs least of those that were executed; `None` if it does not, or if it is the
    /// only one.
    pub fn cheapest_as_executed(&self) -> Option<String> {
        let least = self.least_of_others().filter(|least| least.cost_nm2 >= self.cost_nm2)?;
        if !self.keeps_limits() {
            return None;
        }
        Some(format!(
            " As executed it costs least, too: {} nm^2, the next plan {} nm^2.",
            significant(self.cost_nm2, 3),
            significant(least.cost_nm2, 3)
        ))
    }

    /// Returns a sentence on the executed plan that costs least, if it costs less than this one.
    fn cheaper_as_executed(&self) -> Option<String> {
        let least = self.least_of_others().filter(|least| least.cost_nm2 < self.cost_nm2)?;
        Some(format!(
            "As executed, {} costs less: {} nm^2 instead of {} nm^2, with {} nm RMS in {} s. Its plan is \
             others/{}, without programs.",
            least.words(),
            significant(least.cost_nm2, 3),
            significant(self.cost_nm2, 3),
            significant(least.rms_nm, 3),
            significant(least.time_with_changes_s, 3),
            least.label
        ))
    }

    /// Returns a sentence on the subsets of the rack that were neither solved nor executed, if others were executed.
    fn not_compared(&self) -> Option<String> {
        if self.others.is_empty() || self.subsets.is_empty() {
            return None;
        }
        let tools = self.subsets.iter().map(|subset| &subset.tools);
        let known: BTreeSet<BTreeSet<&String>> = tools
            .chain(self.others.iter().map(|other| &other.tools))
            .map(|tools| tools.iter().collect())
            .collect();
        let open = (1_usize << self.rack_size) - 1 - known.len();
        (open > 0).then(|| {
            format!("{open} subsets of the rack were neither solved nor executed; as executed, one may cost less.")
        })
    }

    /// Returns the sentences on what the motions leave or take beyond the plan, and on waves that remain.
    pub fn own_warnings(&self, waves: Option<WavesLeft>) -> Vec<String> {
        let mut warnings = Vec::new();
        let Some(last) = self.tools.last() else { return warnings };
        if let Some(planned) = last.planned_rms_nm
            && last.rms_nm > WORSE_FROM * planned
        {
            warnings.push(format!(
                "The motion of {} leaves {} nm RMS where its dwell times leave {} nm.",
                last.name,
                significant(last.rms_nm, 3),
                significant(planned, 3)
            ));
        }
        if let Some(chosen) = self.chosen()
            && self.total_time_s > LONGER_FROM * chosen.time_with_changes_s
        {
            warnings.push(format!(
                "The choice knows dwell times alone, {} s with changes; the motions take {} s. Where dwell times are \
                 short, the accelerations of the machine lengthen the run.{}",
                significant(chosen.time_with_changes_s, 3),
                significant(self.total_time_s, 3),
                if self.others.is_empty() { " compare=yes executes the subsets that may then cost less." } else { "" }
            ));
        }
        warnings.extend(self.cheaper_as_executed());
        warnings.extend(self.not_compared());
        if let Some(WavesLeft { period_mm: [x, y], rms_nm }) = waves
            && rms_nm > SHORT_PART * last.rms_nm
        {
            let along = |period: Option<f64>| {
                period.map_or("none".to_string(), |mm| format!("{} mm", significant(mm, 3)))
            };
            warnings.push(format!(
                "Waves remain that no tool of the plan corrects, {} nm RMS: periods of {} along x and {} along y, and \
                 less. Add a narrower tool to the rack if they matter.",
                significant(rms_nm, 3),
                along(x),
                along(y)
            ));
        }
        warnings
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tool(name: &str, planned: f64, rms_nm: f64) -> ToolOfPlan {
        ToolOfPlan {
            name: name.into(),
            width_mm: 10.0,
            before_rms_nm: 40.0,
            mean_removal_nm: 30.0,
            planned_rms_nm: Some(planned),
            rms_nm,
            time_s: 100.0,
            change_s: 60.0,
            elapsed_s: 160.0,
            max_velocity_mm_per_s: [1.0; 2],
            limits_kept: true,
            machine: None,
            program: None,
        }
    }

    fn several() -> Several {
        let subset = Subset {
            tools: vec!["a".into(), "b".into()],
            rms_nm: 1.0,
            time_s: vec![50.0, 60.0],
            time_with_changes_s: 230.0,
            cost_nm2: 5.0,
            is_chosen: true,
        };
        Several {
            tools: vec![tool("a", 1.0, 8.0), tool("b", 1.0, 1.02)],
            total_time_s: 320.0,
            cost_nm2: 6.0,
            rack_size: 3,
            subsets: vec![subset],
            ..Several::default()
        }
    }

    #[test]
    fn a_warning_says_what_differs_and_nothing_else() {
        let mut plan = several();
        assert_eq!(plan.order(), "a, then b");
        let waves = WavesLeft { period_mm: [Some(4.0), None], rms_nm: 0.5 };
        // The map after the first tool is not that of the plan: only the last one counts.
        assert_eq!(plan.own_warnings(Some(waves)), Vec::<String>::new());
        plan.tools[1].rms_nm = 1.2;
        plan.total_time_s = 400.0;
        let found = plan.own_warnings(Some(WavesLeft { rms_nm: 0.9, ..waves }));
        assert_eq!(found.len(), 3, "{found:?}");
        assert!(found[0].contains("b leaves 1.2 nm RMS where its dwell times leave 1 nm"));
        assert!(found[2].contains("0.9 nm RMS: periods of 4 mm along x and none along y"));
    }

    #[test]
    fn the_cheapest_plan_as_executed_is_named_and_what_is_not_known() {
        let other = OtherExecuted {
            label: "a".into(),
            tools: vec!["a".into()],
            price_factor: 1.0,
            rms_nm: 2.0,
            time_s: vec![100.0],
            time_with_changes_s: 160.0,
            cost_nm2: 3.6,
            limits_kept: true,
            report: "../others/a/report/report.html".into(),
        };
        let swept = OtherExecuted {
            label: "prices=0.3".into(),
            tools: vec!["b".into(), "a".into()],
            price_factor: 0.3,
            cost_nm2: 3.5,
            ..other.clone()
        };
        let exceeds = OtherExecuted { cost_nm2: 1.0, limits_kept: false, ..other.clone() };
        let mut plan = Several { others: vec![other, swept, exceeds], ..several() };
        let found = plan.own_warnings(None);
        assert!(
            found[0].starts_with(
                "As executed, b + a, prices x 0.3 costs less: 3.5 nm^2 instead of 6 nm^2"
            ),
            "{found:?}"
        );
        // Of the seven subsets of three tools, {a, b} was solved and {a} executed.
        assert!(found[1].starts_with("5 subsets of the rack were neither"), "{found:?}");
        assert_eq!(plan.cheapest_as_executed(), None);
        plan.cost_nm2 = 3.5;
        assert_eq!(plan.own_warnings(None).len(), 1);
        assert!(
            plan.cheapest_as_executed().unwrap().ends_with("3.5 nm^2, the next plan 3.5 nm^2.")
        );
    }
}
