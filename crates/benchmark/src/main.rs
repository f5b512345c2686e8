//! `planish-benchmark`: starts `planish benchmark`, the program beside it.

fn main() -> std::process::ExitCode {
    planish_launch::launch(env!("CARGO_PKG_NAME"))
}
