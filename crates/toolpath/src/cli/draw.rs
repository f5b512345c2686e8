//! `planish toolpath draw`.

use std::path::PathBuf;

use clap::Args;
use planish_handoff::{
    Failure, Inputs, Status,
    flags::{OutputFileArgs, PathArgs},
    say,
};
use planish_toolpath::svg;
use planish_types::Surface;

#[derive(Debug, Args)]
pub struct DrawArgs {
    #[command(flatten)]
    path: PathArgs,
    /// Map whose valid pixels, the clear aperture, are drawn in grey [surface artifact]
    #[arg(long, value_name = "DIR")]
    surface: Option<PathBuf>,
    #[command(flatten)]
    output: OutputFileArgs,
}

impl DrawArgs {
    pub fn run(&self) -> Result<Status, Failure> {
        let mut inputs = Inputs::new();
        let path = self.path.read(&mut inputs)?;
        let surface: Option<Surface> =
            self.surface.as_ref().map(|dir| inputs.read("surface", dir)).transpose()?;
        let output = self.output.begin(&inputs)?;
        output.write(svg(&path, surface.as_ref()).as_bytes())?;
        let out = self.output.out.display();
        say(format!("planish toolpath: {} segments drawn to {out}", path.len()));
        Ok(Status::Done)
    }
}
