//! Absurd numbers in every numeric flag, and maps that are hardly tools. The rules are those of the stage `surface`.

use std::fs;

use ndarray::Array2;

use crate::surface_hostile::{put, try_maps, try_numbers, usual};

fn tool() -> Array2<f64> {
    Array2::from_shape_fn((7, 7), |(r, c)| {
        let (x, y) = (c as f64 - 3.0, r as f64 - 3.0);
        5.0 * (-(x * x + y * y) / 3.0).exp()
    })
}

/// A subcommand, its flags with a `?` where a hostile number goes, and a number that is usual there.
const FLAGS: [(&str, &str, &str); 25] = [
    ("prepare", "--rotate-deg ?", "30"),
    ("prepare", "--pixel-mm ?", "0.5"),
    ("prepare", "--taper-fraction ?", "0.5"),
    ("prepare", "--fit-formula gaussian --use-fit --pixel-mm ?", "0.5"),
    ("prepare", "--fit-formula super-gaussian --rotate-deg ?", "30"),
    ("rate", "--by incidence --sphere-radius-mm ? --exponent -1.7", "100"),
    ("rate", "--by incidence --sphere-radius-mm 100 --exponent ?", "-1.7"),
    ("rate", "--by x --table rates.txt --error ?", "0.01"),
    ("rate", "--by x --table rates.txt --max-rank ?", "3"),
    ("rate", "--by radius --table rates.txt --spacing-mm ?", "2"),
    ("rate", "--by edge-distance --table rates.txt --beyond-mm ?", "2"),
    ("rate", "--by y --table rates.txt --memory-gib ?", "1"),
    ("spots", "--by x --spot ?=tool --spot 40=tool", "-40"),
    ("spots", "--by incidence --sphere-radius-mm ? --spot 0=tool --spot 60=tool", "100"),
    ("edge", "--error 0.3 --pad-radius-mm ?", "3"),
    ("edge", "--error 0.3 --pad-radius-mm 3 --spacing-mm ?", "2"),
    ("edge", "--error 0.3 --pad-radius-mm 3 --max-rank ?", "20"),
    ("turned", "--error ?", "0.1"),
    ("turned", "--max-rank ?", "5"),
    ("turned", "--follows heading --error ?", "0.1"),
    ("footprint", "--direction normal --sphere-radius-mm ?", "100"),
    ("footprint", "--direction fixed --sphere-radius-mm 100 --exponent ?", "1.5"),
    ("footprint", "--direction fixed --sphere-radius-mm 100 --source-distance-mm ?", "500"),
    ("incidence", "--sphere-radius-mm ? --exponent -1.7", "100"),
    ("incidence", "--sphere-radius-mm 100 --exponent ?", "-1.7"),
];

/// Returns the input flags of a subcommand, each followed by its value.
fn inputs(method: &str) -> &'static [&'static str] {
    match method {
        "prepare" => &["--tif", "tool"],
        "spots" => &["--surface", "map"],
        _ => &["--tif", "tool", "--surface", "map"],
    }
}

#[test]
fn absurd_numbers_end_with_a_result_or_a_message() {
    let tmp = tempfile::tempdir().unwrap();
    let dir = tmp.path();
    put(&dir.join("map"), "height_nm", usual(), 1.0);
    put(&dir.join("tool"), "rate_nm_per_s", tool(), 1.0);
    fs::write(dir.join("rates.txt"), "-30 1\n0 1.2\n30 0.9\n").unwrap();
    try_numbers("planish-tool", dir, &FLAGS, inputs);
}

#[test]
fn maps_that_are_no_tools_are_refused_with_a_message() {
    let tmp = tempfile::tempdir().unwrap();
    let calls: [&[&str]; 3] = [
        &["tif"],
        &[
            "tif",
            "--centre",
            "centroid",
            "--rotate-deg",
            "30",
            "--pixel-mm",
            "0.5",
            "--subtract-border",
        ],
        &["tif", "--taper-fraction", "0.5", "--fit-formula", "gaussian", "--use-fit"],
    ];
    let ends = try_maps("planish-tool", tmp.path(), ["rate_nm_per_s", "--tif"], &calls);
    // Three calls on twelve maps of three pitches.
    assert_eq!(ends, [0, 108]);
}
