//! Runs whose truth is known, made by a simulator of their own: how far the standard errors hold, and how good the next
//! mirror is.
//!
//! `known_truth [CASES [FIRST]]` makes CASES (30) machines on a coupon, a strip and a plate, from seed FIRST (0), each with
//! 0.05 and 0.5 nm of map noise. For each part and noise it prints in how many estimates the truth is within two standard
//! errors, how many parameters are refused, and the residual of the next mirror over that with a known tool. Above the
//! table it names every estimate that is further off, and every next mirror beyond 1.15 times the known tool.
//! `known_truth CASES FIRST budget` gives the sizes from which the errors are drawn as an error budget.

#[path = "../tests/known/mod.rs"]
mod known;

use std::{collections::BTreeMap, env, process::ExitCode};

use known::Case;
use rayon::prelude::*;

/// Ratio of the residual of a next mirror to that with a known tool, above which the case is printed. Larger: only the
/// worst cases. Smaller: cases without a fault.
const NAMED: f64 = 1.15;

/// Counts and ratios over the cases of one part and one noise.
#[derive(Default)]
struct Tally {
    within: usize,
    stated: usize,
    refused: usize,
    /// Residual of the next mirror over that with a known tool: with learning, and without.
    ratios: Vec<[f64; 2]>,
}

fn main() -> ExitCode {
    let number = |k: usize, default| env::args().nth(k).map_or(Ok(default), |w| w.parse::<u64>());
    let (count, first) = match (number(1, 30), number(2, 0)) {
        (Ok(count), Ok(first)) => (count, first),
        (Err(e), _) | (_, Err(e)) => {
            eprintln!("known_truth: {e}; give a number of cases and the first seed");
            return ExitCode::from(2);
        }
    };
    let has_budget = env::args().nth(3).is_some_and(|word| word == "budget");
    let mut tallies: BTreeMap<(String, &str), Tally> = BTreeMap::new();
    let mut names: BTreeMap<String, [usize; 3]> = BTreeMap::new();
    for sigma_nm in [0.05, 0.5] {
        let learn = |seed| {
            let case = Case::new(seed, sigma_nm);
            let found = if has_budget { case.learn_with_budget() } else { case.learn() };
            (seed, case.kind, case.over_errors(&found), case.next_mirror_nm(&found))
        };
        let cases: Vec<_> = (first..first + count).into_par_iter().map(learn).collect();
        for (seed, kind, over_errors, [learnt, without, known]) in cases {
            let mut tally = Tally::default();
            for (name, off) in &over_errors {
                let [within, stated, refused] = names.entry(name.clone()).or_default();
                let Some(off) = off else {
                    (tally.refused, *refused) = (tally.refused + 1, *refused + 1);
                    continue;
                };
                (tally.stated, *stated) = (tally.stated + 1, *stated + 1);
                if off.abs() <= 2.0 {
                    (tally.within, *within) = (tally.within + 1, *within + 1);
                } else {
                    println!("{sigma_nm} nm, case {seed}: {name} is {off:.1} standard errors off");
                }
            }
            if learnt > NAMED * known {
                let refused: Vec<&str> = over_errors
                    .iter()
                    .filter(|(_, off)| off.is_none())
                    .map(|(name, _)| name.as_str())
                    .collect();
                println!(
                    "{sigma_nm} nm, case {seed}: next mirror {learnt:.4} nm, known tool {known:.4}, without learning \
                     {without:.4}; refused: {}",
                    refused.join(", ")
                );
            }
            for part in [kind, "together"] {
                let sum = tallies.entry((format!("{sigma_nm}"), part)).or_default();
                sum.within += tally.within;
                sum.stated += tally.stated;
                sum.refused += tally.refused;
                sum.ratios.push([learnt / known, without / known]);
            }
        }
    }
    println!(
        "noise, nm  part      cases  within two of stated  refused  next mirror over a known tool: median (largest)"
    );
    println!(
        "                                                          with learning         without               worse than without"
    );
    for ((sigma, part), tally) in &tallies {
        let percent = 100.0 * tally.within as f64 / tally.stated.max(1) as f64;
        let [with, without] = [0, 1].map(|k| {
            let mut sorted: Vec<f64> = tally.ratios.iter().map(|r| r[k]).collect();
            sorted.sort_by(f64::total_cmp);
            format!("{:.3} ({:.3})", sorted[sorted.len() / 2], sorted[sorted.len() - 1])
        });
        let worse = tally.ratios.iter().filter(|[a, b]| a > b).count();
        println!(
            "{sigma:<10} {part:<9} {:>5} {percent:>8.1} % of {:<8} {:>7}  {with:<21} {without:<21} {worse}",
            tally.ratios.len(),
            tally.stated,
            tally.refused
        );
    }
    println!("parameter                   within two of stated   refused");
    for (name, [within, stated, refused]) in &names {
        println!("{name:<26} {within:>7} of {stated:<11} {refused:>7}");
    }
    ExitCode::SUCCESS
}
