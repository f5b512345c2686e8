//! `planish campaign report`.

use std::path::{Path, PathBuf};

use clap::Args;
use planish_campaign::{
    decision::Decision,
    page::{answer, page, picture, value_and_deviation},
    summary::{Campaign, Chains, Left, RunRecord},
};
use planish_handoff::{
    Begin, Failure, Inputs, Output, Status, artifact::Manifest, flags::OutputArgs, kind, say, task,
};
use planish_types::{
    Surface,
    outcome::{
        reconciliation::ReconciliationOutcome,
        removal::MeasuredOutcome,
        virtual_machine::{RunSettings, Truth, TruthOutcome},
    },
    text::significant,
};
use serde_json::json;

/// Largest number of runs of a campaign. Larger: a table and a page that nobody can read. Smaller: long campaigns
/// are refused.
const MOST_RUNS: usize = 100;

/// Names of the directories of the three chains (series of runs, see `summary`): with learning, without, and with a
/// known tool.
const CHAINS: [&str; 3] = ["learning", "without", "known"];

#[derive(Args)]
pub struct CampaignReport {
    /// Directory of the campaign, with the directories learning/K, without/K, known/K and alike
    dir: PathBuf,
    /// Map of the mirror before the first run [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: PathBuf,
    /// Number of runs of the campaign
    #[arg(long, value_name = "N")]
    runs: usize,
    /// Name of the mirror
    #[arg(long, value_name = "NAME", default_value = "")]
    mirror: String,
    /// Name of the machine, if nobody named one and it is that of the fixtures; the result says so
    #[arg(long, value_name = "NAME")]
    assumed_machine: Option<String>,
    #[command(flatten)]
    output: OutputArgs,
}

impl CampaignReport {
    pub fn run(&self) -> Result<Status, Failure> {
        if !(1..=MOST_RUNS).contains(&self.runs) {
            return Err(Failure::new(format!("--runs: is {}; give 1 to {MOST_RUNS}", self.runs)));
        }
        let mut inputs = Inputs::new();
        let mirror: Surface = inputs.read("surface", &self.surface)?;
        let mut records = Vec::new();
        let mut hidden: Option<(u64, Truth)> = None;
        for k in 1..=self.runs {
            let places = CHAINS.map(|chain| Path::new(chain).join(k.to_string()));
            let left = self.chains(&mut inputs, &places, k, &mut hidden)?;
            records.push(self.record(&mut inputs, k, left)?);
        }
        let places = CHAINS.map(|chain| Path::new("alike").join(chain));
        let alike = self.chains(&mut inputs, &places, self.runs + 1, &mut hidden)?;
        let settings = json!({
            "mirror": self.mirror, "runs": self.runs, "assumed_machine": self.assumed_machine,
        });
        let output = Output::directory(&self.output, &kind::CAMPAIGN);
        let mut output = match output.begin(&task!("report", settings), &inputs)? {
            Begin::Unchanged(status) => return Ok(status),
            Begin::Run(output) => output,
        };
        let (seed, truth) = hidden.unwrap_or_default();
        let before = mirror.statistics().rms;
        let mut campaign = Campaign::new(&self.mirror, seed, before, &truth, records, alike);
        campaign.assumed_machine =
            self.assumed_machine.as_deref().map(planish_types::assumed_machine);
        let beside = [
            ("campaign.html", page(&campaign).into_bytes()),
            ("campaign.svg", picture(&campaign).into_bytes()),
            ("campaign.csv", csv(&campaign).into_bytes()),
        ];
        output.write_arrays(&kind::CAMPAIGN, &[], &beside, &campaign, &Status::Done)?;
        say(table(&campaign));
        say(format!("-> {}", self.output.out.join("campaign.html").display()));
        Ok(Status::Done)
    }

    /// Reads the manifest of the artifact `name` of the run in the directory `place`. Returns the directory of the
    /// artifact and the manifest.
    fn manifest(
        &self,
        inputs: &mut Inputs,
        place: &Path,
        name: &str,
        kind: &'static kind::Kind,
    ) -> Result<(PathBuf, Manifest), Failure> {
        let dir = self.dir.join(place).join(name);
        let manifest = inputs.read_manifest(&place.join(name).to_string_lossy(), &dir, kind)?;
        Ok((dir, manifest))
    }

    /// Reads the true result of run `k` of each of [`CHAINS`]. The three paths are their directories of this run.
    /// `hidden` receives the seed and the true errors of the virtual machine.
    fn chains(
        &self,
        inputs: &mut Inputs,
        [learning, without, known]: &[PathBuf; 3],
        k: usize,
        hidden: &mut Option<(u64, Truth)>,
    ) -> Result<Chains, Failure> {
        Ok(Chains {
            learning: self.left(inputs, learning, k, false, hidden)?,
            without: self.left(inputs, without, k, false, hidden)?,
            known: self.left(inputs, known, k, true, hidden)?,
        })
    }

    /// Reads the true result of run `k` of one chain from the directory `place`. All runs must be of the same virtual
    /// machine: its seed and its true errors go into `hidden`. Refuses another run than `k`, and a machine with errors
    /// if `is_known` is true, or without errors if it is false.
    fn left(
        &self,
        inputs: &mut Inputs,
        place: &Path,
        k: usize,
        is_known: bool,
        hidden: &mut Option<(u64, Truth)>,
    ) -> Result<Left, Failure> {
        let (dir, manifest) = self.manifest(inputs, place, "truth", &kind::REMOVAL)?;
        let settings: RunSettings = manifest.read_settings(&dir)?;
        if settings.run != k as u64 || settings.known != is_known {
            let which = if is_known { "a machine that is known" } else { "a machine with errors" };
            let problem = format!("is not run {k} of {which}");
            return Err(Failure::new(format!("{}: {problem}; run it again", dir.display())));
        }
        let outcome: TruthOutcome = manifest.read_outcome(&dir, "run it again")?;
        let of_run = outcome.more.hidden.truth;
        match hidden {
            Some((seed, truth)) => {
                let same = *seed == settings.seed && (is_known || *truth == of_run);
                if !same {
                    let problem = "is of another machine than the runs before it; run it again";
                    return Err(Failure::new(format!("{}: {problem}", dir.display())));
                }
            }
            None => *hidden = Some((settings.seed, of_run)),
        }
        Ok(Left { rms_nm: outcome.rms_nm, total_time_s: outcome.total_time_s })
    }

    fn record(&self, inputs: &mut Inputs, k: usize, left: Chains) -> Result<RunRecord, Failure> {
        let place = Path::new("learning").join(k.to_string());
        let (dir, reconciled) =
            self.manifest(inputs, &place, "reconciliation", &kind::RECONCILIATION)?;
        let outcome: ReconciliationOutcome = reconciled.read_outcome(&dir, "reconcile again")?;
        let (dir, measured) = self.manifest(inputs, &place, "measured", &kind::SURFACE)?;
        let MeasuredOutcome { rms_nm: measured_rms_nm, .. } =
            measured.read_outcome(&dir, "measure it again")?;
        let (dir, decision) = self.manifest(inputs, &place, "decision", &kind::DECISION)?;
        let decision: Decision = decision.read_outcome(&dir, "decide again")?;
        let [low, high] = decision.next.interval_95_percent_nm;
        Ok(RunRecord {
            left,
            estimates: outcome.parameters,
            measured_rms_nm,
            verdict: decision.verdict,
            reason: decision.reason,
            expected_nm: [decision.next.median_nm, low, high],
        })
    }
}

/// Returns a row of the table of residuals for the terminal: the RMS (nm) and the time (min) of each chain, and the
/// ratios to the known tool.
fn row(name: &str, chains: &Chains) -> String {
    let mut line = format!("{name:<22}");
    for left in chains.each() {
        line += &format!(" {:>9.4} {:>7.1}", left.rms_nm, left.total_time_s / 60.0);
    }
    let [learning, without] = chains.over_known();
    line + &format!(" {learning:>10.3} {without:>9.3}")
}

/// Returns the true results as comma-separated values for a spreadsheet, a row per run and chain. Run `alike` is that on
/// another mirror like the first.
fn csv(campaign: &Campaign) -> String {
    let mut text = String::from("run,chain,rms_nm,total_time_s\n");
    let runs = campaign.runs.iter().map(|run| (run.number.to_string(), &run.left));
    for (run, chains) in runs.chain([("alike".into(), &campaign.alike)]) {
        for (chain, left) in CHAINS.iter().zip(chains.each()) {
            text += &format!("{run},{chain},{},{}\n", left.rms_nm, left.total_time_s);
        }
    }
    text
}

/// Returns the tables of the report for the terminal: residuals per run, and the learnt parameters beside the truth.
fn table(campaign: &Campaign) -> String {
    let mut lines = vec![
        format!("{}: {}", campaign.mirror, answer(campaign)),
        String::new(),
        "residual on the mirror     with learning          without       known tool   over the known tool".into(),
        "run                       nm RMS     min    nm RMS     min    nm RMS     min   learning   without".into(),
    ];
    lines.extend(campaign.runs.iter().map(|run| row(&run.number.to_string(), &run.left)));
    lines.push(row("another mirror like it", &campaign.alike));
    lines.push(String::new());
    lines.push("learnt, with its standard error (in brackets: by an earlier run), and how many of them it is off".into());
    let mut head = format!("{:<32} {:>10}", "parameter", "truth");
    for run in &campaign.runs {
        head += &format!(" {:>28}", format!("after run {}", run.number));
    }
    lines.push(head);
    for p in 0..campaign.runs.first().map_or(0, |run| run.parameters.len()) {
        let first = &campaign.runs[0].parameters[p];
        let truth = first.truth.map_or("-".into(), |t| significant(t, 4));
        let mut line = format!("{:<32} {truth:>10}", format!("{}, {}", first.name, first.unit));
        for parameter in campaign.runs.iter().filter_map(|run| run.parameters.get(p)) {
            let (value, off) = value_and_deviation(parameter);
            let value = value.replace("&plusmn;", "+-");
            line += &format!(" {value:>22} {off:>5}");
        }
        lines.push(line);
    }
    for run in &campaign.runs {
        let [median, low, high] = run.expected_nm;
        lines.push(String::new());
        lines.push(format!(
            "after run {}: {} ({}); the next run is expected to leave {median:.4} nm ({low:.4} to {high:.4})",
            run.number,
            run.verdict.words(),
            run.reason
        ));
    }
    lines.join("\n")
}
