#[path = "../tests/known/mod.rs"]
mod known;
use known::Case;
use planish_testkit::mirror::mirror;
use rayon::prelude::*;
fn main() {
    let mirror = mirror().unwrap();
    let n: u64 = std::env::args().nth(1).map_or(6, |w| w.parse().unwrap());
    let first: u64 = std::env::args().nth(2).map_or(0, |w| w.parse().unwrap());
    let half: f64 = std::env::args().nth(3).map_or(9.4, |w| w.parse().unwrap());
    for sigma in [0.05, 0.5] {
        let mut lines: Vec<_> = (first..first + n)
            .into_par_iter()
            .map(|seed| {
                let t0 = std::time::Instant::now();
                let case = Case::on_mirror(&mirror, seed, sigma, half);
                let made = t0.elapsed();
                let found = case.learn();
                let mut s = format!("{sigma} seed {seed} made {made:.1?} learnt {:.1?} end {} points {} drawback {:?} {:?} {:?}\n", t0.elapsed() - made, found.outcome.end, found.outcome.points, found.drawback, found.outcome.noise, found.outcome.fitted);
                let mut out = found.outcome.parameters.iter().zip(case.over_errors(&found)).map(|(e, (name, off))| {
                    format!("   {name:<26} off {:<8} value {:?} +- {:?} refused {:?} held {:?} applied {:.4} infl {:?}\n", off.map_or("-".into(), |v| format!("{v:.2}")), e.value, e.standard_error, e.refused, e.held_because, e.applied, e.variance_inflation)
                }).collect::<String>();
                s.push_str(&format!("   truth {:?}\n", case.truth));
                s.push_str(&out);
                out.clear();
                (seed, s)
            })
            .collect();
        lines.sort();
        for (_, l) in lines {
            print!("{l}");
        }
    }
}
