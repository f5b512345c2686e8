//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "additions.rs"]
mod additions;
#[path = "architecture.rs"]
mod architecture;
#[path = "axes_programs.rs"]
mod axes_programs;
#[path = "bspline_feed.rs"]
mod bspline_feed;
#[path = "conventions.rs"]
mod conventions;
#[path = "equivariance.rs"]
mod equivariance;
#[path = "load.rs"]
mod load;
#[path = "outcomes.rs"]
mod outcomes;
#[path = "papers.rs"]
mod papers;
#[path = "programs.rs"]
mod programs;
#[path = "reach.rs"]
mod reach;
#[path = "reconcile.rs"]
mod reconcile;
#[path = "reference.rs"]
mod reference;
#[path = "reproduce.rs"]
mod reproduce;
#[path = "schedulers.rs"]
mod schedulers;
#[path = "spectra.rs"]
mod spectra;
#[path = "tif_shapes.rs"]
mod tif_shapes;
#[path = "tolerance.rs"]
mod tolerance;
#[path = "tool_paths.rs"]
mod tool_paths;
#[path = "varying.rs"]
mod varying;
