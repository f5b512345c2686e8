//! Division of the aperture into regions of one depth class, and their continuation beyond the aperture.

use std::{cmp::Reverse, collections::BinaryHeap};

use ndarray::{Array2, Axis as Dimension};
use planish_types::{Grid, Surface};

use crate::{MAX_SEGMENTS, region::SLACK};

/// Label of a pixel without a class or a region.
pub(super) const OUTSIDE: usize = usize::MAX;

/// Radius at which the Gaussian is cut off, in standard deviations; it is 3e-4 of its peak there.
/// Larger: more time. Smaller: steps in the smoothed depth.
const CUT_OFF: f64 = 4.0;

/// Returns the depth to be removed, nm, smoothed by a Gaussian of the standard deviation `sigma_mm` over the valid
/// pixels; NaN elsewhere. If the map has negative heights, its minimum is subtracted first.
pub(super) fn depth_nm(surface: &Surface, sigma_mm: f64) -> Array2<f64> {
    let grid = surface.grid();
    let z = surface.height_nm();
    let lowest = surface.statistics().min.min(0.0);
    let mut sum = z.map(|z| if z.is_nan() { 0.0 } else { z - lowest });
    let mut weight = z.map(|z| if z.is_nan() { 0.0 } else { 1.0 });
    // sum_j g_ij r_j / sum_j g_ij over the valid pixels j
    for (dimension, axis) in [(1, &grid.x), (0, &grid.y)] {
        let reach = (CUT_OFF * sigma_mm / axis.step_mm()).ceil().min((axis.len() - 1) as f64);
        let g: Vec<f64> = (0..=reach as usize)
            .map(|k| (-0.5 * (k as f64 * axis.step_mm() / sigma_mm).powi(2)).exp())
            .collect();
        for map in [&mut sum, &mut weight] {
            for mut lane in map.lanes_mut(Dimension(dimension)) {
                let old = lane.to_vec();
                for (i, v) in lane.iter_mut().enumerate() {
                    let near = i.saturating_sub(g.len() - 1)..(i + g.len()).min(old.len());
                    *v = near.map(|j| g[i.abs_diff(j)] * old[j]).sum();
                }
            }
        }
    }
    let mut depth = sum / weight;
    depth.zip_mut_with(z, |r, z| {
        if z.is_nan() {
            *r = f64::NAN;
        }
    });
    // Rounding of a mean does not divide a constant map.
    let [low, high] = range(&depth);
    if high - low <= SLACK * high {
        depth.mapv_inplace(|r| if r.is_nan() { r } else { high });
    }
    depth
}

/// Returns the smallest and the largest value of `map` that is not NaN.
pub(super) fn range(map: &Array2<f64>) -> [f64; 2] {
    let valid = map.iter().filter(|v| !v.is_nan());
    valid.fold([f64::MAX, f64::MIN], |[low, high], v| [low.min(*v), high.max(*v)])
}

/// The 4-connected components of the depth classes.
pub(super) struct Components {
    /// Component of every pixel, shape (ny, nx); [`OUTSIDE`] where there is none.
    pub label: Array2<usize>,
    /// Class of every component.
    pub class: Vec<usize>,
    /// Number of pixels of every component.
    pub pixels: Vec<usize>,
}

/// Returns the 4-connected components of the classes `class_of`. Those with fewer pixels than `least_pixels` of their
/// class are merged into the class that is most frequent around them, if they have a neighbour.
pub(super) fn components(class_of: &Array2<usize>, least_pixels: &[f64]) -> Components {
    let mut label = Array2::from_elem(class_of.dim(), OUTSIDE);
    let mut class: Vec<usize> = Vec::new();
    let mut members: Vec<Vec<[usize; 2]>> = Vec::new();
    for ((r, c), k) in class_of.indexed_iter() {
        if *k == OUTSIDE || label[[r, c]] != OUTSIDE {
            continue;
        }
        let id = class.len();
        let mut pixels = vec![[r, c]];
        let mut next = 0;
        label[[r, c]] = id;
        while let Some(pixel) = pixels.get(next).copied() {
            next += 1;
            for n in neighbours(pixel, class_of.dim()) {
                if class_of[n] == *k && label[n] == OUTSIDE {
                    label[n] = id;
                    pixels.push(n);
                }
            }
        }
        class.push(*k);
        members.push(pixels);
    }

    let mut smallest: BinaryHeap<_> =
        members.iter().enumerate().map(|(id, m)| Reverse((m.len(), id))).collect();
    while let Some(Reverse((size, id))) = smallest.pop() {
        // One that has grown or gone since is in the heap again, or need not be.
        if members[id].len() != size || size as f64 >= least_pixels[class[id]] {
            continue;
        }
        let around = members[id].iter().flat_map(|pixel| neighbours(*pixel, label.dim()));
        let mut ring: Vec<[usize; 2]> =
            around.filter(|n| label[*n] != OUTSIDE && label[*n] != id).collect();
        ring.sort_unstable();
        ring.dedup();
        let mut count = vec![0_usize; least_pixels.len()];
        ring.iter().for_each(|n| count[class[label[*n]]] += 1);
        let Some(most) = (0..count.len()).max_by_key(|k| (count[*k], Reverse(*k))) else {
            continue;
        };
        if count[most] == 0 {
            continue; // an island
        }
        let mut joined: Vec<usize> =
            ring.iter().map(|n| label[*n]).filter(|j| class[*j] == most).collect();
        joined.push(id);
        joined.sort_unstable();
        joined.dedup();
        let largest = joined.iter().copied().max_by_key(|j| (members[*j].len(), Reverse(*j)));
        let Some(into) = largest else { continue };
        class[into] = most;
        for j in joined.into_iter().filter(|j| *j != into) {
            let moved = std::mem::take(&mut members[j]);
            moved.iter().for_each(|pixel| label[*pixel] = into);
            members[into].extend(moved);
        }
        smallest.push(Reverse((members[into].len(), into)));
    }

    // Without the ones that have gone.
    let mut number = vec![OUTSIDE; class.len()];
    let remaining: Vec<usize> = (0..class.len()).filter(|id| !members[*id].is_empty()).collect();
    remaining.iter().enumerate().for_each(|(n, id)| number[*id] = n);
    label.mapv_inplace(|id| if id == OUTSIDE { OUTSIDE } else { number[id] });
    Components {
        label,
        class: remaining.iter().map(|id| class[*id]).collect(),
        pixels: remaining.iter().map(|id| members[*id].len()).collect(),
    }
}

fn neighbours([r, c]: [usize; 2], (ny, nx): (usize, usize)) -> impl Iterator<Item = [usize; 2]> {
    let all = [[r.wrapping_sub(1), c], [r, c.wrapping_sub(1)], [r, c + 1], [r + 1, c]];
    all.into_iter().filter(move |[r, c]| *r < ny && *c < nx)
}

/// The regions with their overscan, on the pixels of the map and further ones added around it.
pub(super) struct Field {
    /// Region of every pixel, rows along y; [`OUTSIDE`] beyond the overscan.
    pub label: Array2<usize>,
    /// True for the pixels of the aperture.
    pub inside: Array2<bool>,
    /// Pixel pitch along [x, y], mm.
    pub pixel_mm: [f64; 2],
    /// Centre [x, y] of the first pixel, mm.
    pub first_mm: [f64; 2],
    /// Distance from the last pixel's centre to the end of the overscan [x, y], mm: from -1/2 to
    /// 1/2 of a pixel, so that no line leaves the pixels of its region.
    pub rest_mm: [f64; 2],
}

impl Field {
    /// Returns the centre of a column (axis 0) or a row (axis 1), mm.
    pub fn centre_mm(&self, axis: usize, index: usize) -> f64 {
        self.first_mm[axis] + index as f64 * self.pixel_mm[axis]
    }

    /// Continues the labels of the map by `overscan_mm` to each side: each new pixel has the region of the nearest
    /// valid one. `None` if that needs too many pixels.
    pub fn new(grid: &Grid, label: &Array2<usize>, overscan_mm: f64) -> Option<Self> {
        let axes = [&grid.x, &grid.y];
        let pixel_mm = axes.map(|a| a.step_mm());
        let more = pixel_mm.map(|h| (overscan_mm / h - 0.5 - SLACK).ceil().max(0.0));
        let (ny, nx) = label.dim();
        let pixels = (nx as f64 + 2.0 * more[0]) * (ny as f64 + 2.0 * more[1]);
        if pixels > 2.0 * MAX_SEGMENTS as f64 {
            return None;
        }
        let [mx, my] = more.map(|m| m as usize);
        let (ny, nx) = (ny + 2 * my, nx + 2 * mx);
        let mut inside = Array2::from_elem((ny, nx), false);
        // The nearest valid pixel of the column: its distance and its region.
        let mut column = Array2::from_elem((ny, nx), (OUTSIDE, OUTSIDE));
        for ((r, c), id) in label.indexed_iter().filter(|(_, id)| **id != OUTSIDE) {
            inside[[r + my, c + mx]] = true;
            for row in r..=r + 2 * my {
                let near = &mut column[[row, c + mx]];
                *near = (*near).min((row.abs_diff(r + my), *id));
            }
        }
        let mut wide = Array2::from_elem((ny, nx), OUTSIDE);
        for ((r, c), nearest) in wide.indexed_iter_mut() {
            let mut best = f64::INFINITY;
            for away in 0..=mx {
                let dx = away as f64 * pixel_mm[0];
                if dx * dx >= best {
                    break;
                }
                for from in [c.wrapping_sub(away), c + away] {
                    let Some((rows, id)) = column.get((r, from)) else { continue };
                    let dy = *rows as f64 * pixel_mm[1];
                    if *id != OUTSIDE && dx * dx + dy * dy < best {
                        best = dx * dx + dy * dy;
                        *nearest = *id;
                    }
                }
            }
        }
        Some(Self {
            label: wide,
            inside,
            pixel_mm,
            first_mm: [0, 1].map(|i| axes[i].start_mm() - more[i] * pixel_mm[i]),
            rest_mm: [0, 1].map(|i| overscan_mm - more[i] * pixel_mm[i]),
        })
    }
}
