//! `planish-app`: starts `planish app`, the program beside it.

fn main() -> std::process::ExitCode {
    planish_launch::launch(env!("CARGO_PKG_NAME"))
}
