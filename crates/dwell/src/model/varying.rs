//! The kernels of a tool whose TIF varies over the part, each with its places (positions of the tool with fractions of
//! the dwell time).
//!
//! ```text
//! B_ij = g(x_i) sum_k sum_q a_k(p_q) w_q phi_k(x_i - p_q)                                 (1)
//! ```
//!
//! over the kernels k and the places q of column j, at p_q with the fraction w_q: (1) of [`planish_types::Variation`].
//! `a_k` is the weight of kernel phi_k, with its factor of the heading, and `g` the factor of the pixel. Each kernel
//! gets the places with the fractions `a_k w_q`, so that every form of B for a constant tool serves it.

use std::borrow::Cow;

use planish_types::{Tif, Variation};

use super::place::ToolPlace;

/// Returns the kernels of a tool, each with the places of every column, whose fractions are multiplied by the weights
/// of the kernel. A tool that does not vary is its own only kernel, with the places unchanged.
pub fn kernels<'a>(
    places: &'a [Vec<ToolPlace>],
    tif: &'a Tif,
) -> impl ExactSizeIterator<Item = (&'a Tif, Cow<'a, [Vec<ToolPlace>]>)> {
    let count = tif.variation().map_or(1, |v| v.components().len());
    (0..count).map(move |k| match tif.variation() {
        None => (tif, Cow::Borrowed(places)),
        Some(v) => {
            let weighted = places
                .iter()
                .map(|places| places.iter().map(|p| weighted(v, k, p)).collect())
                .collect();
            (v.components()[k].kernel(), Cow::Owned(weighted))
        }
    })
}

/// Returns the place with its fraction multiplied by the weight of kernel number `kernel` at its position and heading.
pub fn weighted(variation: &Variation, kernel: usize, place: &ToolPlace) -> ToolPlace {
    let weight = variation.weight(kernel, place.pose());
    ToolPlace { fraction: weight * place.fraction, ..*place }
}

/// Returns places whose fractions are multiplied by `int K^2 / int R^2`: the energy of the TIF K at the place, without
/// the factor of the pixels, over that of the mean TIF R. The places of a tool that does not vary stay as they are.
pub fn by_energy<'a>(places: &'a [Vec<ToolPlace>], tif: &Tif) -> Cow<'a, [Vec<ToolPlace>]> {
    let Some(v) = tif.variation() else { return Cow::Borrowed(places) };
    let rates: Vec<_> = v.components().iter().map(|c| c.kernel().rate_nm_per_s()).collect();
    let products: Vec<Vec<f64>> =
        rates.iter().map(|a| rates.iter().map(|b| (*a * *b).sum()).collect()).collect();
    let of_mean: f64 = tif.rate_nm_per_s().iter().map(|r| r * r).sum();
    let by_energy = |p: &ToolPlace| {
        let a: Vec<f64> = (0..rates.len()).map(|k| v.weight(k, p.pose())).collect();
        let rows = a.iter().zip(&products);
        let energy: f64 = rows
            .map(|(a_k, row)| a_k * row.iter().zip(&a).map(|(g, a_l)| g * a_l).sum::<f64>())
            .sum();
        ToolPlace { fraction: p.fraction * energy / of_mean, ..*p }
    };
    places.iter().map(|places| places.iter().map(by_energy).collect()).collect()
}
