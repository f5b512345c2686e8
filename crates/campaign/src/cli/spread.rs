//! `planish-campaign spread`.

use std::path::PathBuf;

use clap::Args;
use planish_campaign::{decision::Verdict, summary::Campaign};
use planish_handoff::{Failure, Inputs, Status, kind, say};

#[derive(Args)]
pub struct Spread {
    /// Reports of campaigns that have the same number of runs [campaign artifacts]
    #[arg(required = true)]
    reports: Vec<PathBuf>,
}

impl Spread {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let mut campaigns: Vec<Campaign> = Vec::new();
        for (k, dir) in self.reports.iter().enumerate() {
            let manifest = inputs.read_manifest(&format!("report {k}"), dir, &kind::CAMPAIGN)?;
            let about = |problem: String| Failure::new(format!("{}: {problem}", dir.display()));
            let campaign: Campaign = manifest.read_outcome(dir, "make it again")?;
            let runs = campaigns.first().map_or(campaign.runs.len(), |first| first.runs.len());
            if campaign.runs.len() != runs || runs == 0 {
                let problem = format!("has {} runs, and the first has {runs}", campaign.runs.len());
                return Err(about(format!("{problem}; give campaigns with as many runs each")));
            }
            campaigns.push(campaign);
        }
        say(table(&campaigns));
        Ok(Status::Done)
    }
}

/// Table for the terminal.
fn table(campaigns: &[Campaign]) -> String {
    let runs = campaigns[0].runs.len();
    let mut lines = vec![
        format!("{} campaigns of {runs} runs: residual over that of a tool that is known", campaigns.len()),
        "                              with learning                      without".into(),
        "run                     median   least    most  <= 1.1     median   least    most  run again".into(),
    ];
    for k in 0..=runs {
        let left = |c: &Campaign| c.runs.get(k).map_or(c.alike, |run| run.left).over_known();
        let [learning, without] =
            [0, 1].map(|i| sorted(campaigns.iter().map(|c| left(c)[i]).collect()));
        let within = learning.iter().filter(|v| **v <= 1.1).count();
        let again =
            |c: &&Campaign| c.runs.get(k).is_some_and(|run| run.verdict == Verdict::RunAgain);
        let (name, again) = match k < runs {
            true => {
                let again = campaigns.iter().filter(again).count();
                (format!("{}", k + 1), format!("{again:>10}"))
            }
            false => ("another mirror like it".into(), String::new()),
        };
        let numbers = |v: &[f64]| {
            let median = 0.5 * (v[(v.len() - 1) / 2] + v[v.len() / 2]);
            format!("{median:>7.3} {:>7.3} {:>7.3}", v[0], v[v.len() - 1])
        };
        lines.push(format!(
            "{name:<22} {} {within:>7}    {}{again}",
            numbers(&learning),
            numbers(&without)
        ));
    }
    lines.extend(expected(campaigns));
    lines.push(parameters(campaigns));
    lines.join("\n")
}

/// Lines on the results of each next run: ratio to the expected median, and number of results within the interval.
fn expected(campaigns: &[Campaign]) -> Vec<String> {
    let runs = campaigns[0].runs.len();
    let line = |k: usize| {
        let (mut below, mut within, mut ratio) = (0, 0, 0.0);
        for c in campaigns {
            let ([median, low, high], left) =
                (c.runs[k].expected_nm, c.runs[k + 1].left.learning.rms_nm);
            below += usize::from(left <= high);
            within += usize::from((low..=high).contains(&left));
            ratio += left / median / campaigns.len() as f64;
        }
        format!(
            "run {} left {ratio:.3} times the median that was expected of it (mean); in {within} of {} campaigns within the \
             interval of 95 %, in {below} not more than its end",
            k + 2,
            campaigns.len()
        )
    };
    (0..runs - 1).map(line).collect()
}

/// Line on the parameters after the last run: number whose truth is within two standard errors of the learnt value.
fn parameters(campaigns: &[Campaign]) -> String {
    let (mut determined, mut all, mut within) = (0, 0, 0);
    for learnt in campaigns.iter().flat_map(|c| c.runs.last()).flat_map(|run| &run.parameters) {
        all += 1;
        if let (Some(v), Some(e), Some(t)) = (learnt.value, learnt.standard_error, learnt.truth) {
            determined += 1;
            within += usize::from((v - t).abs() <= 2.0 * e);
        }
    }
    format!(
        "after the last run {determined} of {all} parameters were determined, {within} of these within two standard errors of \
         the truth"
    )
}

fn sorted(mut values: Vec<f64>) -> Vec<f64> {
    values.sort_unstable_by(f64::total_cmp);
    values
}
