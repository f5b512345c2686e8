//! The integration tests of this library, as one program. `crates/planish/tests` has those that run programs.

#[path = "fit.rs"]
mod fit;
#[path = "maps.rs"]
mod maps;
#[path = "series.rs"]
mod series;
