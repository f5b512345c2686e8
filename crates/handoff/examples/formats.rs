//! Prints `docs/formats.md`.

fn main() {
    print!("{}", planish_handoff::kind::formats_markdown());
}
