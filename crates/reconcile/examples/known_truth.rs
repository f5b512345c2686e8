//! Runs whose truth is known, made by a simulator of their own: how far the standard errors hold, and how good the next
//! mirror is.
//!
//! `cargo run --release -p planish-reconcile --example known_truth -- [CASES]` (60) makes as many cases of several parts,
//! tools and paths, each at 0.05 and 0.5 nm of map noise. It prints how many truths are within two standard errors, and
//! the residual of the next mirror over that with a known tool.

#[path = "../tests/known/mod.rs"]
mod known;

use std::{env, process::ExitCode};

use known::Case;

fn main() -> ExitCode {
    if let (Some(seed), Some(sigma)) = (env::args().nth(2), env::args().nth(3)) {
        let case = Case::new(seed.parse().unwrap(), sigma.parse().unwrap());
        let found = case.learn();
        println!("{} {:?}", case.kind, case.truth);
        for (e, (_, off)) in found.outcome.parameters.iter().zip(case.over_errors(&found)) {
            println!(
                "{:<26} {:?} se {:?} off {off:?} applied {} vif {:?}\n   ref {:?}\n   held {:?}",
                e.name,
                e.value,
                e.standard_error,
                e.applied,
                e.variance_inflation,
                e.refused,
                e.held_because
            );
        }
        println!(
            "{:?} {:?} {} {} {:?}",
            found.outcome.fitted,
            found.outcome.noise,
            found.outcome.end,
            found.outcome.points,
            found.outcome.tif_is_as_sampled
        );
        println!("{:?}", case.next_mirror_nm(&found));
        return ExitCode::SUCCESS;
    }
    let count = match env::args().nth(1).map_or(Ok(60), |w| w.parse::<u64>()) {
        Ok(count) => count,
        Err(e) => {
            eprintln!("known_truth: {e}; give a number of cases");
            return ExitCode::from(2);
        }
    };
    for sigma_nm in [0.05, 0.5] {
        let (mut within, mut of, mut refused, mut ratios) = (0, 0, 0, Vec::new());
        let mut names: Vec<(String, [usize; 3])> = Vec::new();
        for seed in 0..count {
            let case = Case::new(seed, sigma_nm);
            let found = case.learn();
            for (k, (name, off)) in case.over_errors(&found).into_iter().enumerate() {
                if names.len() <= k {
                    names.push((name, [0; 3]));
                }
                let tally = &mut names[k].1;
                match off {
                    None => (refused, tally[2]) = (refused + 1, tally[2] + 1),
                    Some(off) => {
                        of += 1;
                        tally[1] += 1;
                        if off.abs() <= 2.0 {
                            within += 1;
                            tally[0] += 1;
                        } else {
                            println!(
                                "  case {seed}: {} is {off:.1} standard errors off",
                                names[k].0
                            );
                        }
                    }
                }
            }
            let [learnt, without, known] = case.next_mirror_nm(&found);
            ratios.push([learnt / known, without / known]);
        }
        println!("noise {sigma_nm} nm, {count} cases");
        let percent = 100.0 * f64::from(within) / f64::from(of.max(1));
        println!("within two standard errors: {percent:.1} % of {of}; not determined: {refused}");
        for (name, [within, of, refused]) in names {
            println!("  {name:<26} {within:>3} of {of:>3}, not determined {refused}");
        }
        for (k, name) in ["with learning", "without"].into_iter().enumerate() {
            let mut sorted: Vec<f64> = ratios.iter().map(|r| r[k]).collect();
            sorted.sort_by(f64::total_cmp);
            let (median, most) = (sorted[sorted.len() / 2], sorted[sorted.len() - 1]);
            let beyond = sorted.iter().filter(|r| **r > 1.15).count();
            println!(
                "next mirror over a known tool, {name}: median {median:.3}, most {most:.3}, {beyond} beyond 1.15"
            );
        }
        let worse = ratios.iter().filter(|[a, b]| a > b).count();
        println!("learning is worse than not learning in {worse}");
    }
    ExitCode::SUCCESS
}
