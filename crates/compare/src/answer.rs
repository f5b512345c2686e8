//! Answer at the top of a report: the plan that is to be run, its residual, and the reason for this choice.
//!
//! The sentences are made here once, for the page and for other programs (`answer` in `summary.json`). Every number
//! in them is a rounded number of the summary.

pub use planish_types::outcome::report::Answer;
use planish_types::{
    outcome::{
        report::AnsweredSummary,
        specification::{Bound, SpecificationReport},
    },
    text::{fixed, significant},
};
use serde::Serialize;
use serde_json::{Value, json};

use crate::{
    plan::{PROGRAM, State},
    recommended::recommended,
    several::Several,
    summary::{MethodResult, Summary},
};

/// Number of significant digits of a number in a sentence. Larger: sentences that are slow to read. Smaller: plans
/// that differ look equal. Chosen; the summary has all digits.
const DIGITS: usize = 3;

/// Duration from which a sentence uses minutes instead of seconds, s ([`HOURS_FROM_S`]: hours instead of minutes).
/// Larger: numbers above 120 in a sentence. Smaller: numbers below 2. Chosen: two minutes, and two hours.
const MINUTES_FROM_S: f64 = 120.0;
const HOURS_FROM_S: f64 = 7200.0;

/// Returns the answer of a run: a sentence on the recommended plan (`summary.best`), and the reasons. If the summary
/// recommends none of its methods, the answer says that nothing is to be run, and why.
pub fn answer(summary: &Summary) -> Answer {
    if let Some(several) = &summary.several {
        return answer_of_tools(summary, several);
    }
    let best = summary.methods.iter().find(|(name, _)| Some(name) == summary.best.as_ref());
    let mut problems = summary.remarks.clone();
    let (sentence, why) = match best {
        Some((name, method)) => {
            problems.extend(against(name, method));
            (sentence(summary, name, method), why(summary, name, method))
        }
        None => {
            problems.push(summary.why_no_plan().into());
            ("Nothing here is to be run.".into(), why_none(summary))
        }
    };
    let still = summary.methods.iter().find(|(_, m)| m.plan.state == State::WithoutMotion);
    let without_motion = still.map(|(name, m)| {
        format!(
            "Not a plan: {name} applies the dwell times at the dwell points, without a motion between them. It \
             leaves {} nm RMS in {}; no machine can run it, and a plan may leave less.",
            significant(m.rms_nm, DIGITS),
            duration(m.total_time_s)
        )
    });
    Answer { method: best.map(|(name, _)| name.clone()), sentence, why, without_motion, problems }
}

/// Returns the answer of a plan of several tools: their order, the time with changes, and the reason for the choice. If
/// a motion exceeds a limit, the answer says that nothing is to be run.
fn answer_of_tools(summary: &Summary, several: &Several) -> Answer {
    let mut problems = summary.remarks.clone();
    for tool in several.tools.iter().filter(|tool| !tool.limits_kept) {
        problems.push(format!("The motion of {} exceeds a limit of its machine.", tool.name));
    }
    let last = summary.methods.last().filter(|_| several.keeps_limits());
    let sentence = match last {
        Some((_, m)) => {
            let mut machines: Vec<&str> =
                several.tools.iter().filter_map(|tool| tool.machine.as_deref()).collect();
            machines.dedup();
            let machine = match &machines[..] {
                [] => String::new(),
                names => format!(" on {}", names.join(", then ")),
            };
            format!(
                "Run {}{machine}, in {} with changes of tools: {} to {} nm RMS{}; the limits of the machine are kept.",
                several.order(),
                duration(several.total_time_s),
                significant(summary.initial.rms_nm, DIGITS),
                significant(m.rms_nm, DIGITS),
                worst_place(m)
            )
        }
        None => "Nothing here is to be run.".into(),
    };
    Answer {
        method: last.map(|(name, _)| name.clone()),
        sentence,
        why: why_of_tools(several),
        without_motion: None,
        problems,
    }
}

/// Returns a sentence with the reason for the choice of the tools.
fn why_of_tools(several: &Several) -> String {
    let Some(chosen) = several.chosen() else {
        return format!("{}: all tools of the rack, without a choice.", several.order());
    };
    let all = (1_u128 << several.rack_size.min(100)) - 1;
    let proof = match several.relative_gap_of_choice {
        Some(gap) if gap <= 0.0 => "no subset costs less".into(),
        Some(gap) => format!("no subset costs less by more than {gap:.1e} of its cost"),
        None => "nothing proves that no other costs less".into(),
    };
    format!(
        "{}, because their dwell times cost least of the {} subsets of the rack that were solved, of {all}: {} nm RMS in \
         {} with changes; {proof}.{}",
        chosen.tools.join(" and "),
        several.subsets.len(),
        significant(chosen.rms_nm, DIGITS),
        duration(chosen.time_with_changes_s),
        several.cheapest_as_executed().unwrap_or_default()
    )
}

/// Returns the worst place of a residual as the continuation of a sentence; empty if it is not known.
fn worst_place(m: &MethodResult) -> String {
    m.places.worst.first().map_or(String::new(), |worst| {
        format!(
            ", worst {} nm from the mean at x {}, y {} mm",
            significant(worst.from_mean_nm, DIGITS),
            fixed(worst.x_mm, 1),
            fixed(worst.y_mm, 1)
        )
    })
}

/// Returns one run as JSON for other programs and for the page: its answer, then its summary.
pub(crate) fn with_answer(summary: &Summary) -> Value {
    json!(AnsweredSummary { answer: answer(summary), summary })
}

/// The plan to be run, chosen among the recommended plans of several runs on one mirror.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Winner {
    /// Name of the run; `None` if the runs cannot be compared.
    pub run: Option<String>,
    /// Name of the method (the scheduler or solver of the plan) in that run; `None` if `run` is.
    pub method: Option<String>,
    /// Residual and time in a sentence, or the reason why the runs cannot be compared.
    pub sentence: String,
}

impl Winner {
    fn none(why: &str) -> Self {
        let sentence = format!("No run is named as the one to be run: {why}.");
        Self { run: None, method: None, sentence }
    }
}

/// Returns the winner of several runs among their recommended plans, by the rule of [`crate::recommended`]. Returns
/// `None` for fewer than two runs, or if no run has a recommended plan.
///
/// The winner names no run if the maps before the runs differ in RMS or PV. The same holds if the plans are judged by
/// specifications of different names, or if only some of them are predicted after the servo.
pub fn winner(runs: &[(&str, &Summary)]) -> Option<Winner> {
    let (_, first) = runs.first().filter(|_| runs.len() > 1)?;
    let same_map = |s: &Summary| {
        (s.initial.rms_nm, s.initial.pv_nm) == (first.initial.rms_nm, first.initial.pv_nm)
    };
    if !runs.iter().all(|(_, summary)| same_map(summary)) {
        return Some(Winner::none("their maps before the run differ"));
    }
    let mut best = Vec::new();
    for (run, summary) in runs {
        let mut methods = summary.methods.iter();
        if let Some((method, plan)) = methods.find(|(name, _)| Some(name) == summary.best.as_ref())
        {
            best.push((*run, method, plan));
        }
    }
    let (.., first) = best.first()?;
    let specification = |plan: &MethodResult| plan.specification.as_ref().map(|s| s.name.clone());
    if best.iter().any(|(.., plan)| specification(plan) != specification(first)) {
        return Some(Winner::none("they are not judged by the same specification"));
    }
    let is_after_servo = first.after_servo_rms_nm.is_some();
    if best.iter().any(|(.., plan)| plan.after_servo_rms_nm.is_some() != is_after_servo) {
        return Some(Winner::none("some are predicted after the servo, others are not"));
    }
    let candidates: Vec<_> = best.iter().map(|named| (named, named.2.candidate())).collect();
    let (run, method, plan) = recommended(&candidates)?;
    let plan = plan.candidate();
    let sentence = format!(
        "Of the {} runs, {run} is to be run, by {method}: {} nm RMS in {}.",
        runs.len(),
        significant(plan.rms_nm, DIGITS),
        duration(plan.total_time_s)
    );
    Some(Winner { run: Some(run.to_string()), method: Some(method.to_string()), sentence })
}

/// Returns the content of `summary.json`: answer and summary of the run if there is one;
/// `{"winner": ..., "runs": [...]}` otherwise. Each pair is the name of a run and its summary.
pub(crate) fn to_json(runs: &[(&str, &Summary)]) -> Value {
    match runs {
        [(_, one)] => with_answer(one),
        several => {
            let each: Vec<Value> = several.iter().map(|(_, run)| with_answer(run)).collect();
            json!({ "winner": winner(several), "runs": each })
        }
    }
}

/// Returns the sentence on the plan `name`, such as "pvt runs on ion-beam in 7.45 min: 6.3 to 0.158 nm RMS, worst ...;
/// the limits of the machine are kept." `summary` has the numbers of the run, and `m` those of the plan.
fn sentence(summary: &Summary, name: &str, m: &MethodResult) -> String {
    let machine = m.machine.as_deref().map_or(String::new(), |machine| format!(" on {machine}"));
    let mut text = format!(
        "{name} runs{machine} in {}: {} to {} nm RMS",
        duration(m.total_time_s),
        significant(summary.initial.rms_nm, DIGITS),
        significant(m.rms_nm, DIGITS)
    );
    if let Some(short) = m.short_wave_rms_nm {
        text +=
            &format!(" ({} in waves shorter than the tool corrects)", significant(short, DIGITS));
    }
    text += &worst_place(m);
    text += "; the limits of the machine are kept";
    match &m.specification {
        Some(judged) if judged.passed => {
            text += &format!("; the specification {} is kept", judged.name);
        }
        Some(judged) => text += &format!("; the specification {} is not kept", judged.name),
        None => {}
    }
    text + "."
}

/// Returns sentences with the reasons for the choice of the plan `name`, which is to be run.
fn why(summary: &Summary, name: &str, m: &MethodResult) -> String {
    let choice = match plan_of_program(summary, name, m) {
        None => format!("{name}, because {}.", reason(summary, name, m, None)),
        Some((base, plan)) => {
            let others =
                summary.methods.iter().filter(|(other, m)| other != name && m.is_candidate());
            let others: Vec<_> = others.map(|(other, m)| (other, m.candidate())).collect();
            match recommended(&others) {
                Some(best) if best != base => format!(
                    "{name}, because it is the program that was written, of {base}; without it the choice is {best}."
                ),
                _ => format!(
                    "{name}, because it is the program of {base}, and {base} is chosen because {}.",
                    reason(summary, base, plan, Some(name))
                ),
            }
        }
    };
    format!(
        "{choice}{}{} Its plan is marked \"{}\": {}.{}",
        after_servo(name, m),
        beside_bound(summary, m),
        m.plan.word,
        m.plan.text,
        exceeding(summary)
    )
}

/// Returns a sentence on the residual that no path can beat in the time of a plan; empty if the run has no bound.
fn beside_bound(summary: &Summary, m: &MethodResult) -> String {
    let Some(bounds) = &summary.bound else { return String::new() };
    let bound_nm = bounds.at_time_nm(m.total_time_s);
    // Dwell times that leave this in less time leave at most as much in this time.
    let within = bounds.bounds.iter().filter(|bound| bound.time_s <= m.total_time_s);
    let reached_nm = within.map(|bound| bound.reached_rms_nm).fold(m.rms_nm, f64::min);
    if bound_nm <= 0.0 {
        return " In this time the bound on any path is 0 nm RMS, so that it says nothing of the plan.".into();
    }
    format!(
        " In this time no path and no motion of this tool leaves less than {} nm RMS; the plan leaves {} % more. The \
         bound itself may be up to {} % too low.",
        significant(bound_nm, DIGITS),
        fixed(100.0 * (m.rms_nm / bound_nm - 1.0), 1),
        fixed(100.0 * (reached_nm / bound_nm - 1.0), 1)
    )
}

/// Returns the plan from which the controller program `name` (such as `joint+galil`) was written, with its name. `None`
/// if `m` was not read back from a program, or if its plan is not in the run or may not be recommended.
fn plan_of_program<'a>(
    summary: &'a Summary,
    name: &str,
    m: &MethodResult,
) -> Option<(&'a String, &'a MethodResult)> {
    let (base, _) = name.rsplit_once('+').filter(|_| m.plan.word == PROGRAM)?;
    let (base, plan) = summary.methods.iter().find(|(other, _)| other == base)?;
    Some((base, plan)).filter(|(_, plan)| plan.is_candidate())
}

/// Returns the reason for the choice of the plan `name`, with the result `m`, as a clause. It compares the plan with
/// that of the least RMS among the other candidates; without another one, it says so. `program` names the method that
/// is the program of this plan, which does not count as another.
fn reason(summary: &Summary, name: &str, m: &MethodResult, program: Option<&str>) -> String {
    let rivals: Vec<&(String, MethodResult)> = summary
        .methods
        .iter()
        .filter(|(other, _)| other != name && Some(other.as_str()) != program)
        .filter(|(_, m)| m.is_candidate())
        .collect();
    let by_rms = rivals.iter().map(|rival| (rival.1.compared_rms_nm(), rival));
    let Some((_, (next, other))) = by_rms.min_by(|a, b| a.0.total_cmp(&b.0)) else {
        return "it is the only plan here that keeps the limits".into();
    };
    let plans = rivals.len() + 1;
    let mine = m.candidate();
    let rival = other.candidate();
    let [_, their_nm] = apart([mine.rms_nm, rival.rms_nm], significant);
    let [my_time, their_time] = apart([mine.total_time_s, rival.total_time_s], duration_of);
    let theirs = format!("{next} with {their_nm} nm in {their_time}");
    let [mine_keeps, theirs_keeps] =
        [m, other].map(|m| m.specification.as_ref().is_some_and(|judged| judged.passed));
    if mine.rms_nm <= rival.rms_nm {
        format!(
            "it leaves the least RMS of the {plans} plans that keep the limits; the next is {theirs}"
        )
    } else if mine_keeps && !theirs_keeps {
        format!("it keeps the specification, which {theirs} does not")
    } else {
        let more_percent = 100.0 * (mine.rms_nm / rival.rms_nm - 1.0);
        format!(
            "it takes {my_time} and leaves {} % more than the least RMS of the {plans} plans that keep the limits, \
             {theirs}; one percent of the time counts as half a percent of the mean square",
            significant(more_percent, 2)
        )
    }
}

/// Returns the sentence that the plans are compared after the servo of the machine; empty if `m` has no RMS after the
/// servo.
fn after_servo(name: &str, m: &MethodResult) -> String {
    m.after_servo_rms_nm.map_or(String::new(), |rms_nm| {
        format!(
            " The plans are compared by the RMS after the servo of the process, where {name} leaves {} nm.",
            significant(rms_nm, DIGITS)
        )
    })
}

/// Returns the reasons why no plan is to be run: the plans that exceed limits, or the sentence that the run has no plan
/// that could be run.
fn why_none(summary: &Summary) -> String {
    let exceeding = exceeding(summary);
    if exceeding.is_empty() {
        return "The run has no plan that could be run.".into();
    }
    exceeding.trim_start().into()
}

/// Returns sentences that name the plans which exceed the limits of the machine, each with the limits that it breaks.
/// Each sentence begins with a blank. Dwell times without a motion are left out; the text is empty if no plan remains.
fn exceeding(summary: &Summary) -> String {
    let mut text = String::new();
    for (name, m) in &summary.methods {
        if m.limits_respected || m.plan.state == State::WithoutMotion {
            continue;
        }
        text += &match m.broken_limits[..] {
            [] => format!(" {name} exceeds the limits of the machine."),
            ref limits => format!(" {name} does not keep: {}.", limits.join(", ")),
        };
    }
    text
}

/// Returns the reasons against the plan `name`, although it is to be run: it did not converge, or it does not keep the
/// specification. The list is empty if neither holds.
fn against(name: &str, m: &MethodResult) -> Vec<String> {
    let mut reasons = Vec::new();
    if m.plan.state == State::Unconverged {
        reasons.push(format!("the plan of {name} is not optimal: {}", m.plan.text));
    }
    if let Some(judged) = m.specification.as_ref().filter(|judged| !judged.passed) {
        reasons.push(failing(name, judged));
    }
    reasons
}

/// Returns a clause that names the limits of a specification which a plan does not keep. `judged` is the verdict on the
/// residual of the plan `name`.
fn failing(name: &str, judged: &SpecificationReport) -> String {
    let failed = judged.limits.iter().filter(|limit| !limit.passed);
    let limits = failed.map(|l| {
        let value =
            if l.value.is_finite() { significant(l.value, DIGITS) } else { "infinite".into() };
        let unit = if l.unit.is_empty() { String::new() } else { format!(" {}", l.unit) };
        let bound = match l.bound {
            Bound::AtMost => "at most",
            Bound::AtLeast => "at least",
        };
        let limit = significant(l.limit, DIGITS);
        let place = l.worst.as_ref().map_or(String::new(), |worst| format!(", worst {worst}"));
        format!("{} is {value}{unit}, {bound} {limit} is allowed{place}", l.quantity)
    });
    let limits: Vec<String> = limits.collect();
    format!("{name} does not keep the specification {}: {}", judged.name, limits.join("; "))
}

/// Largest number of significant digits in a comparison of two numbers. Larger: the rounding of a sum looks like a
/// difference. Smaller: numbers that differ look equal. Chosen: fewer digits than the rounding of a sum over the
/// segments of a motion leaves intact.
const MOST_DIGITS: usize = 9;

/// Returns two numbers as text, with as many digits as tell them apart, from [`DIGITS`] to [`MOST_DIGITS`].
/// `in_words` writes its first argument with as many significant digits as the second says.
fn apart([a, b]: [f64; 2], in_words: impl Fn(f64, usize) -> String) -> [String; 2] {
    let digits = (DIGITS..MOST_DIGITS).find(|n| in_words(a, *n) != in_words(b, *n));
    let digits = digits.unwrap_or(if a == b { DIGITS } else { MOST_DIGITS });
    [in_words(a, digits), in_words(b, digits)]
}

/// Returns the duration `time_s` in seconds, minutes or hours, with three significant digits and the unit.
pub fn duration(time_s: f64) -> String {
    duration_of(time_s, DIGITS)
}

/// Returns the duration `time_s` in seconds, minutes or hours, with `digits` significant digits and the unit.
fn duration_of(time_s: f64, digits: usize) -> String {
    let (time, unit) = match time_s {
        t if t < MINUTES_FROM_S => (t, "s"),
        t if t < HOURS_FROM_S => (t / 60.0, "min"),
        t => (t / 3600.0, "h"),
    };
    format!("{} {unit}", significant(time, digits))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_are_told_in_what_people_plan_with() {
        let told = [0.25, 119.9, 120.0, 453.69, 7200.0, 36000.0].map(duration);
        assert_eq!(told, ["0.25 s", "120 s", "2 min", "7.56 min", "2 h", "10 h"]);
    }

    #[test]
    fn two_numbers_have_the_digits_that_tell_them_apart() {
        // 28 008 s and 28 011 s are both 7.78 h.
        assert_eq!(apart([28008.0, 28011.0], duration_of), ["7.78 h", "7.781 h"]);
        assert_eq!(apart([0.15104, 0.15101], significant), ["0.15104", "0.15101"]);
        assert_eq!(apart([2.0, 3.0], significant), ["2", "3"]);
        assert_eq!(apart([1.0 / 3.0, 1.0 / 3.0], significant), ["0.333", "0.333"]);
        assert_eq!(apart([1.0, 1.0 + 1e-12], significant), ["1", "1"]);
    }

    #[test]
    fn what_fails_is_told_with_value_limit_and_place() {
        let limit =
            |quantity: &str, value, passed| planish_types::outcome::specification::LimitReport {
                quantity: quantity.into(),
                unit: "nm".into(),
                value,
                limit: 2.0,
                bound: Bound::AtMost,
                passed,
                worst: (!passed).then(|| "at x 3 mm".into()),
                noise: None,
            };
        let limits = vec![
            limit("RMS", 1.0, true),
            limit("PV", 3.456, false),
            limit("B", f64::INFINITY, false),
        ];
        let judged = SpecificationReport { name: "strict".into(), passed: false, limits };
        assert_eq!(
            failing("pvt", &judged),
            "pvt does not keep the specification strict: PV is 3.46 nm, at most 2 is allowed, worst at x 3 mm; \
             B is infinite nm, at most 2 is allowed, worst at x 3 mm"
        );
    }
}
