//! The verdicts of `examples/reproduce`: they follow the numbers, and one that changes is counted.

#[allow(dead_code)] // the example uses all of it
#[path = "../examples/reproduce/claim.rs"]
mod claim;

use claim::{Claim, changed, comma_separated, table};

fn number(ours: f64) -> Claim {
    Claim::number("residual", "nm", 0.204, ours, 0.01)
}

#[test]
fn a_number_that_moves_out_of_its_tolerance_changes_the_verdict() {
    assert_eq!(changed(&[number(0.2043)]), 0);
    // Beyond the tolerance on both sides, the other sign, no number.
    for ours in [0.202 - 1e-3, 0.207, -0.204, 0.0, f64::NAN, f64::INFINITY] {
        assert_eq!(changed(&[number(0.2043), number(ours)]), 1, "{ours}");
    }
}

#[test]
fn a_number_that_should_differ_must_differ() {
    assert_eq!(changed(&[number(0.3).differs("another part")]), 0);
    assert_eq!(changed(&[number(0.204).differs("another part")]), 1);
}

#[test]
fn better_is_only_what_is_smaller() {
    let small =
        |ours| Claim::small("residual", "nm", 0.204, ours, 0.01).better("it is the minimum");
    assert_eq!(changed(&[small(0.148)]), 0);
    for ours in [0.204, 0.3, f64::NAN] {
        assert_eq!(changed(&[small(ours)]), 1, "{ours}");
    }
}

#[test]
fn a_statement_follows_what_holds() {
    let statement = |holds| Claim::statement("it is so", "it is", "it is not".into(), holds);
    let check = |holds| Claim::check("it is so", "1 nm".into(), holds);
    assert_eq!(
        changed(&[statement(true), check(true), statement(false).differs("of the edge")]),
        0
    );
    assert_eq!(
        changed(&[statement(false), check(false), statement(true).differs("of the edge")]),
        3
    );
}

#[test]
fn the_page_says_what_changed() {
    let text = table(&[number(0.2043), number(0.3), Claim::check("so", "1 nm".into(), true)]);
    let rows: Vec<&str> = text.lines().skip(2).collect();
    assert_eq!(rows[0], "| residual | 0.204 nm | 0.204 nm | 1.00 | agrees within 1 % |");
    assert_eq!(rows[1], "| residual | 0.204 nm | 0.300 nm | 1.47 | differs; EXPECTED: Agrees |");
    assert_eq!(rows[2], "| so | not given | 1 nm |  | holds |");
    let different = [number(0.2043), number(0.3)].map(|claim| claim.is_different());
    assert_eq!(different, [false, true]);
    let quoted = comma_separated(&[Claim::check("a \"b\", c", "1 nm".into(), true)]);
    assert_eq!(
        quoted.lines().nth(1),
        Some("\"a \"\"b\"\", c\",\"not given\",\"1 nm\",\"\",\"holds\"")
    );
}
