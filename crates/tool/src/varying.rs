//! Tools that vary over the part or in time, computed from the cause of the variation.
//!
//! A cause says which tool acts at every place: a function K(p) of the position p of the tool whose value is a TIF on
//! one grid of offsets u. [`low_rank`] turns it into kernels and weights, `K(u; p) = sum_k a_k(p) phi_k(u)`. Every
//! program takes a varying tool in this form ([`planish_types::Variation`]).
//!
//! | cause | function | rank |
//! |---|---|---|
//! | rate by place, or by the incidence of a beam | [`RateLaw`] | 1 |
//! | spots measured at several parameters | [`Spots`] | number of spots |
//! | pad that hangs over the edge | [`Overhang`] | 1, or about 3 |
//! | spot that turns with the azimuth, or with the motion | [`turned`] | 10 to 100 |
//! | tool along the normal of a curved part, or of fixed direction | [`Footprint`] | 1 to 20 |
//! | rate by time | [`planish_types::TimeFactor`] | 1 |
//!
//! | module | what it holds |
//! |---|---|
//! | `low_rank` | kernels and weights of a function of the place, to a stated error |
//! | `place` | parameters of a place: distance to the edge, incidence, radius |
//! | `footprint` | the tool on a curved part |
//! | `causes` | the other tools of the table |

mod causes;
mod footprint;
mod low_rank;
mod place;

pub use causes::{Overhang, PressureLaw, RateLaw, Spots, tool_at, turned};
pub use footprint::{Carrier, Direction, Footprint, ToolFrame};
pub use low_rank::{
    At, LocalTool, LowRank, LowRankReport, LowRankSettings, Samples, Used, low_rank,
    low_rank_by_azimuth, low_rank_by_heading,
};
pub use place::{Parameter, Places};
