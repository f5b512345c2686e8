//! `planish-run words`.

use clap::Args;
use planish_handoff::{Failure, Status, say, words};

#[derive(Args)]
pub struct Words {
    /// Text, for example a list of flags
    #[arg(allow_hyphen_values = true)]
    text: String,
}

impl Words {
    pub fn run(&self) -> Result<Status, Failure> {
        let text = &self.text;
        let words = words::split(text).map_err(|e| Failure::new(format!("{text}: {e}")))?;
        say(words::join(words));
        Ok(Status::Done)
    }
}
