//! The claims of the four papers, computed: `reproduce [pvt|trig-spline|bspline|multi-pitch]`, all
//! of them without an argument.
//!
//! Prints the tables of a paper, and writes them as CSV files to `docs/reproduction/`, beside the figures. The rows that
//! differ from the paper are also in `docs/reproduction-*.md`, between the markers of the table. Tables of the reference mirror are made when `PLANISH_REFERENCE`
//! is set, and stay as they are otherwise. Exit 1 when a verdict is not the one stated in the code.
//!
//! Numbers of papers are only compared with, and never used to compute ours. "Better" is said only of the
//! same part and tool, "lower" of another part or tool. A number that follows from its inputs alone is
//! called arithmetic.

mod bspline;
mod claim;
mod figure;
mod lines;
mod multi_pitch;
mod node_velocities;
mod plate;
mod pvt;
mod trig_spline;

use std::{env, fs, process::ExitCode, time::Instant};

use claim::{Claim, comma_separated, table};
use planish_fixture::{Fixture, Recipe, make};
use planish_testkit::workspace;

/// Result of the module of a paper: its tables and figures.
#[derive(Default)]
pub struct Outcome {
    /// Marker of each table in the page, and its rows.
    pub tables: Vec<(&'static str, Vec<Claim>)>,
    /// Name of each figure, and its SVG.
    pub figures: Vec<(&'static str, String)>,
}

type Paper = (&'static str, fn() -> Outcome);

const PAPERS: [Paper; 4] = [
    ("pvt", pvt::reproduce),
    ("trig-spline", trig_spline::reproduce),
    ("bspline", bspline::reproduce),
    ("multi-pitch", multi_pitch::reproduce),
];

/// The recipe of a fixture.
pub fn recipe(name: &str) -> Recipe {
    let file = workspace().join("fixtures").join(format!("{name}.json"));
    let text = fs::read_to_string(file).expect("the recipe is in fixtures/");
    serde_json::from_str(&text).expect("a recipe")
}

/// A fixture.
pub fn fixture(name: &str) -> Fixture {
    make(&recipe(name)).expect("a fixture")
}

/// `page` with `text` between the markers of `name`.
fn filled(page: &str, name: &str, text: &str) -> String {
    let begin = format!("<!-- table: {name} -->\n");
    let start = page.find(&begin).expect("the page has a marker for every table") + begin.len();
    let end = start + page[start..].find("<!-- end -->").expect("every marker has an end");
    format!("{}{text}{}", &page[..start], &page[end..])
}

fn main() -> ExitCode {
    let wanted = env::args().nth(1).filter(|name| !name.is_empty() && name != "all");
    let chosen: Vec<&Paper> =
        PAPERS.iter().filter(|(name, _)| wanted.as_deref().is_none_or(|w| w == *name)).collect();
    if chosen.is_empty() {
        let names: Vec<&str> = PAPERS.iter().map(|(name, _)| *name).collect();
        let wanted = wanted.unwrap_or_default();
        eprintln!("there is no paper {wanted:?}; give one of {}", names.join(", "));
        return ExitCode::from(2);
    }
    let docs = workspace().join("docs");
    let mut changed = 0;
    for (name, reproduce) in chosen {
        let start = Instant::now();
        let file = docs.join(format!("reproduction-{name}.md"));
        let mut page = fs::read_to_string(&file).expect("every paper has its page");
        let outcome = reproduce();
        for (marker, claims) in &outcome.tables {
            println!("{marker}\n\n{}", table(claims));
            changed += claim::changed(claims);
            let file = docs.join("reproduction").join(format!("{marker}.csv"));
            fs::write(file, comma_separated(claims)).expect("docs/reproduction is writable");
            let different = claims.iter().filter(|claim| claim.is_different());
            page = filled(&page, marker, &table(different));
        }
        for (figure, svg) in &outcome.figures {
            let file = docs.join("reproduction").join(format!("{figure}.svg"));
            fs::write(file, svg).expect("docs/reproduction is writable");
        }
        fs::write(&file, page).expect("the page is writable");
        println!("{name}: {:.1} s\n", start.elapsed().as_secs_f64());
    }
    if changed > 0 {
        eprintln!("{changed} verdict(s) are not the expected ones");
        return ExitCode::from(1);
    }
    ExitCode::SUCCESS
}
