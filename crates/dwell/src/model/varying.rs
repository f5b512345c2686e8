//! The kernels of a tool that varies, each with the places at which it removes.
//!
//! ```text
//! B_ij = g(x_i) sum_k sum_q a_k(p_q) w_q phi_k(x_i - p_q)                                 (1)
//! ```
//!
//! over the places q of column j: (1) of [`planish_types::Variation`]. A kernel sees the places of the tool with the
//! fractions `a_k w`, so that every form of B for a constant tool serves each of them.

use std::borrow::Cow;

use planish_types::{Tif, Variation};

use super::place::ToolPlace;

/// Returns the kernels of a tool, each with its places in the columns. A tool that does not vary is its own only
/// kernel, with the same places.
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

/// Returns a place whose fraction is multiplied by the weight of one kernel of the variation there.
pub fn weighted(variation: &Variation, kernel: usize, place: &ToolPlace) -> ToolPlace {
    let weight = variation.weight(kernel, place.pose());
    ToolPlace { fraction: weight * place.fraction, ..*place }
}

/// Returns places whose fractions are multiplied by the energy of the tool there over that of the mean tool, `int K^2
/// / int R^2`. The places of a tool that does not vary stay as they are.
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
