//! Depth and sharpness of the valleys that a removal makes. `valleys RUN_DIR` reads the surface and the
//! removal of every method of a run. It takes the profile along x that the removal leaves of a plane (the
//! removal upside down, mean over the middle half of the rows), and prints per method
//!
//! * the depth of every valley (a local minimum of the desired profile 20 % of its PV below the crests
//!   beside it) below the mean of those crests, desired and predicted, and the error;
//! * the amplitude spectrum at the harmonics of the profile (Hann window), predicted over desired.

use std::{env, fs, path::Path};

use planish_handoff::artifact;
use planish_types::{Removal, Surface};

/// Profile along x that a removal leaves of a plane, mean over the middle half of the rows, nm.
fn profile(map: &ndarray::Array2<f64>) -> Vec<f64> {
    let ny = map.nrows();
    let rows = ny / 4..ny - ny / 4;
    let n = rows.len() as f64;
    (0..map.ncols()).map(|c| -rows.clone().map(|r| map[[r, c]]).sum::<f64>() / n).collect()
}

/// Places (crest before, valley, crest after) of the valleys of `z`.
fn valleys(z: &[f64]) -> Vec<[usize; 3]> {
    let (low, high) = z.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    let enough = 0.2 * (high - low);
    // Extrema that differ by more than `enough`, alternating.
    let mut turns: Vec<usize> = vec![0];
    let mut rising = true;
    for k in 1..z.len() {
        let last = *turns.last().expect("it holds one");
        if rising == (z[k] > z[last]) {
            *turns.last_mut().expect("it holds one") = k;
        } else if (z[k] - z[last]).abs() > enough {
            turns.push(k);
            rising = !rising;
        }
    }
    turns.windows(3).filter(|w| z[w[1]] < z[w[0]]).map(|w| [w[0], w[1], w[2]]).collect()
}

/// Depth below the mean of the crests, each sought within `reach` pixels of its place.
fn depth(z: &[f64], [a, valley, b]: [usize; 3], reach: usize) -> f64 {
    let near = |k: usize| &z[k.saturating_sub(reach)..(k + reach + 1).min(z.len())];
    let crest = |k: usize| near(k).iter().copied().fold(f64::MIN, f64::max);
    let low = near(valley).iter().copied().fold(f64::MAX, f64::min);
    0.5 * (crest(a) + crest(b)) - low
}

/// Amplitude at `frequency` (per mm) under a Hann window.
fn amplitude(z: &[f64], step_mm: f64, frequency: f64) -> f64 {
    let n = z.len() as f64;
    let mean = z.iter().sum::<f64>() / n;
    let (mut re, mut im) = (0.0, 0.0);
    for (k, v) in z.iter().enumerate() {
        let window = 1.0 - (2.0 * std::f64::consts::PI * k as f64 / n).cos();
        let (s, c) = (2.0 * std::f64::consts::PI * frequency * k as f64 * step_mm).sin_cos();
        re += window * (v - mean) * c;
        im += window * (v - mean) * s;
    }
    2.0 * re.hypot(im) / n
}

fn main() {
    let run = env::args().nth(1).expect("give the directory of a run");
    let run = Path::new(&run);
    let surface: Surface = artifact::read(&run.join("surface")).expect("a surface").value;
    let step = surface.grid().x.step_mm();
    let desired = profile(surface.height_nm());
    let found = valleys(&desired);
    let reach = (0.3 / step).round() as usize;
    let mut names: Vec<_> = fs::read_dir(run.join("methods"))
        .expect("the methods of the run")
        .map(|e| e.expect("an entry").file_name().into_string().expect("a name"))
        .collect();
    names.sort();
    println!(
        "{} valleys; depth desired | predicted, nm; amplitude predicted / desired",
        found.len()
    );
    let bands: Vec<f64> = (1..=5).map(|k| 0.25 * f64::from(k)).collect();
    for name in names {
        let dir = run.join("methods").join(&name).join("removal");
        let removal: Removal = artifact::read(&dir).expect("a removal").value;
        let predicted = profile(removal.removal_nm());
        let depths: Vec<[f64; 2]> = found
            .iter()
            .map(|v| [depth(&desired, *v, reach), depth(&predicted, *v, reach)])
            .collect();
        let n = depths.len() as f64;
        let mean = |k: usize| depths.iter().map(|d| d[k]).sum::<f64>() / n;
        let rms = (depths.iter().map(|d| (d[1] - d[0]).powi(2)).sum::<f64>() / n).sqrt();
        println!("{name}: depth {:.1} | {:.1}, error {rms:.1} RMS", mean(0), mean(1));
        let ratios: Vec<String> = bands
            .iter()
            .map(|f| {
                let ratio = amplitude(&predicted, step, *f) / amplitude(&desired, step, *f);
                format!("{f:.2}/mm {ratio:.3}")
            })
            .collect();
        println!("  {}", ratios.join("  "));
        let text: Vec<String> = depths.iter().map(|d| format!("{:.0}|{:.0}", d[0], d[1])).collect();
        println!("  {}", text.join("  "));
    }
}
