//! `planish sweep propose`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{Failure, Status, say};
use planish_sweep::{
    plan::Round,
    search::{Made, growth, in_words, proposals},
};

use super::super::files::{read_row, read_sweep, write_json};

#[derive(Args)]
pub struct Propose {
    /// Directory of the sweep, whose plans are made
    dir: PathBuf,
    /// Relative growth of the area that the front dominates, in the last round, below which the
    /// search ends
    #[arg(long, value_name = "P", default_value_t = 0.01)]
    least_move: f64,
    /// Largest number of rounds
    #[arg(long, value_name = "N", default_value_t = 8)]
    most_rounds: usize,
}

impl Propose {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut sweep = read_sweep(&self.dir)?;
        let mut made: Vec<Made<'_>> = Vec::new();
        let mut before = 0;
        for (i, round) in sweep.rounds.iter().enumerate() {
            for plan in &round.plans {
                let Some(row) = read_row(&self.dir, &plan.id)? else {
                    let problem =
                        format!("{} has no row; make the plans of round {i} first", plan.id);
                    return Err(Failure::new(problem));
                };
                let eligible = row.eligible(&sweep.constraints);
                made.extend(eligible.map(|numbers| (plan, numbers.point())));
            }
            if i + 2 == sweep.rounds.len() {
                before = made.len();
            }
        }
        let rounds = sweep.rounds.len() - 1;
        if rounds > 0 {
            let points: Vec<[f64; 2]> = made.iter().map(|(_, point)| *point).collect();
            let moved = growth(&points, before);
            say(format!("round {rounds}: the front moved by {:.2} %", 100.0 * moved));
            if moved < self.least_move {
                let most = 100.0 * self.least_move;
                return Ok(Status::Negative(format!(
                    "the front moves by less than {most} %: the search is over"
                )));
            }
            if rounds >= self.most_rounds {
                return Ok(Status::Negative(format!(
                    "{rounds} rounds are done, and the front still moves"
                )));
            }
        }
        let all: Vec<_> = sweep.plans().collect();
        let proposed = proposals(&made, &all, &sweep.ground);
        if proposed.is_empty() {
            return Ok(Status::Negative(
                "nothing lies between the plans of the front: the search is over".into(),
            ));
        }
        for plan in &proposed {
            say(in_words(plan));
        }
        sweep.rounds.push(Round::new(proposed));
        write_json(&self.dir.join("sweep.json"), &sweep)?;
        Ok(Status::Done)
    }
}
