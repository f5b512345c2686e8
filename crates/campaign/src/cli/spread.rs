//! `planish campaign spread`.

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
            let campaign: Campaign = manifest.read_outcome(dir, "make it again")?;
            let runs = campaigns.first().map_or(campaign.runs.len(), |first| first.runs.len());
            if campaign.runs.len() != runs || runs == 0 {
                return Err(Failure::new(format!(
                    "{}: has {} runs, and the first has {runs}; give campaigns with as many runs each",
                    dir.display(),
                    campaign.runs.len()
                )));
            }
            campaigns.push(campaign);
        }
        say(table(&campaigns));
        Ok(Status::Done)
    }
}

/// Returns the table for the terminal: median, least and largest ratio of the residual to that of the known tool, run
/// by run.
fn table(campaigns: &[Campaign]) -> String {
    let runs = campaigns[0].runs.len();
    let mut lines = vec![
        format!("{} campaigns of {runs} runs: residual over that of a tool that is known", campaigns.len()),
        "                              with learning                      without".into(),
        "run                     median   least    most  <= 1.1     median   least    most  run again".into(),
    ];
    for k in 0..=runs {
        let mut ratios = [vec![], vec![]];
        let mut again = 0;
        for campaign in campaigns {
            let run = campaign.runs.get(k);
            let [learning, without] = run.map_or(campaign.alike, |run| run.left).over_known();
            ratios[0].push(learning);
            ratios[1].push(without);
            again += usize::from(run.is_some_and(|run| run.verdict == Verdict::RunAgain));
        }
        let [learning, without] = ratios.map(sorted);
        let within = learning.iter().filter(|v| **v <= 1.1).count();
        let numbers = format!("{} {within:>7}    {}", spread(&learning), spread(&without));
        lines.push(if k < runs {
            format!("{:<22} {numbers}{again:>10}", k + 1)
        } else {
            format!("another mirror like it {numbers}")
        });
    }
    lines.extend(expected(campaigns));
    lines.push(parameters(campaigns));
    lines.join("\n")
}

/// Writes the median, the least and the largest of `values`, which ascend and are not empty.
fn spread(values: &[f64]) -> String {
    let median = 0.5 * (values[(values.len() - 1) / 2] + values[values.len() / 2]);
    format!("{median:>7.3} {:>7.3} {:>7.3}", values[0], values[values.len() - 1])
}

/// Returns lines of text on the results of each next run: the ratio of the RMS to the expected median, and the number
/// of results within the expected interval.
fn expected(campaigns: &[Campaign]) -> Vec<String> {
    let runs = campaigns[0].runs.len();
    let mut lines = Vec::new();
    for k in 0..runs - 1 {
        let mut below = 0;
        let mut within = 0;
        let mut ratio = 0.0;
        for c in campaigns {
            let [median, low, high] = c.runs[k].expected_nm;
            let left = c.runs[k + 1].left.learning.rms_nm;
            below += usize::from(left <= high);
            within += usize::from((low..=high).contains(&left));
            ratio += left / median / campaigns.len() as f64;
        }
        lines.push(format!(
            "run {} left {ratio:.3} times the median that was expected of it (mean); in {within} of {} campaigns within the \
             interval of 95 %, in {below} not more than its end",
            k + 2,
            campaigns.len()
        ));
    }
    lines
}

/// Returns a line of text on the parameters after the last run: how many true values are within two standard errors
/// of the learnt value.
fn parameters(campaigns: &[Campaign]) -> String {
    let mut determined = 0;
    let mut all = 0;
    let mut within = 0;
    for parameter in campaigns.iter().flat_map(|c| c.runs.last()).flat_map(|run| &run.parameters) {
        all += 1;
        if let (Some(v), Some(e), Some(t)) =
            (parameter.value, parameter.standard_error, parameter.truth)
        {
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
