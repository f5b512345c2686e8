//! Prints `docs/formats.md`.

fn main() {
    print!("{}", planish_handoff::formats::formats_markdown());
}
