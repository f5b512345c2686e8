//! Several tools in one problem against a dense program, one tool, planted times and each other.

use ndarray::{Array2, ArrayView2, s};
use planish_dwell::{
    DwellError,
    bounded_least_squares::{
        Bound, BoundedReport, BoundedSettings, RackTool, SetupDraw, SeveralSolution, ToolTask,
        choose_tools, execute_with_errors, solve, solve_keeping, solve_several,
    },
    columns::{Columns, patches},
};
use planish_numerics::qp::nnls::nnls;
use planish_types::{Axis, End, Grid, SetupErrors, Surface, Tif, ToolPath};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::definition::Penalty;

/// Returns the grid of the map: 12 x 9 mm in pixels of 0.25 mm.
fn grid() -> Grid {
    Grid { x: Axis::new(0.0, 0.25, 49).unwrap(), y: Axis::new(0.0, 0.25, 37).unwrap() }
}

/// Returns a bell-shaped TIF of a radius that is a multiple of 0.25 mm, with this peak, on the pixels of the map.
fn bell(radius_mm: f64, peak_nm_per_s: f64) -> Tif {
    let a = Axis::new(-radius_mm, 0.25, (8.0 * radius_mm) as usize + 1).unwrap();
    let g = Grid { x: a, y: a };
    let rate = Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c) / radius_mm, g.y.coordinate_mm(r) / radius_mm);
        peak_nm_per_s * (1.0 - x * x - y * y).max(0.0).powi(6)
    });
    Tif::new(g, rate).unwrap()
}

/// Returns a boustrophedon with steps and lines `pitch` mm apart over the rectangle from `start` of the given size, mm.
fn raster(start: [f64; 2], size: [f64; 2], pitch: f64) -> ToolPath {
    let [nx, ny] = size.map(|size| (size / pitch).round() as usize);
    let mut points = Vec::new();
    for j in 0..=ny {
        for i in 0..=nx {
            let i = if j % 2 == 0 { i } else { nx - i };
            points.push([start[0] + pitch * i as f64, start[1] + pitch * j as f64]);
        }
    }
    let n = points.len() - 1;
    ToolPath::through(points, vec![true; n], vec![0; n]).unwrap()
}

/// Returns a desired removal of some 30 nm with long and short waves (ny, nx), nm.
fn waves() -> Array2<f64> {
    let g = grid();
    Array2::from_shape_fn(g.shape(), |(r, c)| {
        let (x, y) = (g.x.coordinate_mm(c) - 5.0, g.y.coordinate_mm(r) - 4.0);
        30.0 + 0.6 * x * x - 0.3 * x * y + 0.4 * y * y + 4.0 * (1.4 * x).sin() * (1.1 * y).cos()
    })
}

fn surface(height: Array2<f64>) -> Surface {
    Surface::new(grid(), height).unwrap()
}

/// Returns a tool without bounds but 0, at this price of a second.
fn tool<'a>(name: &'a str, tif: &'a Tif, path: &'a ToolPath, price: f64) -> ToolTask<'a> {
    ToolTask {
        name,
        tif,
        path,
        min_dwell: Bound::Seconds(0.0),
        max_dwell: None,
        time_weight_nm2_per_s: price,
        setup: SetupErrors::default(),
    }
}

/// Returns settings with which the solver goes on to rounding; a plan is content with less.
fn to_rounding() -> BoundedSettings {
    let (tolerance_s, relative_gap) = (1e-11, 0.0);
    BoundedSettings {
        columns: Columns::Point,
        tolerance_s,
        relative_gap,
        ..BoundedSettings::default()
    }
}

fn times(solution: &SeveralSolution) -> Vec<f64> {
    solution.dwell.iter().flat_map(|dwell| dwell.dwell_s().to_vec()).collect()
}

/// Returns the columns of B (pixels, n) for a tool that rests at its dwell points, by the definition of the TIF, nm/s.
fn columns_by_definition(tif: &Tif, path: &ToolPath) -> Array2<f64> {
    let g = grid();
    let nx = g.x.len();
    let shape = (nx * g.y.len(), path.len());
    Array2::from_shape_fn(shape, |(i, j)| {
        let d = path.dwell_point_mm()[j];
        tif.rate_at(g.x.coordinate_mm(i % nx) - d[0], g.y.coordinate_mm(i / nx) - d[1])
    })
}

/// The quadratic program of a problem of several tools as dense arrays: `f = x'Hx / 2 - g'x + constant`.
struct DenseProgram {
    h: Array2<f64>,
    g: Vec<f64>,
    constant: f64,
}

impl DenseProgram {
    /// Makes the program by definition, for equal weights, a free piston and times >= 0.
    fn new(desired: &Array2<f64>, tools: &[ToolTask<'_>], settings: &BoundedSettings) -> Self {
        let pixels = desired.len() as f64;
        let z: Vec<f64> = desired.iter().copied().collect();
        let mean = z.iter().sum::<f64>() / pixels;
        let z = Array2::from_shape_fn((z.len(), 1), |(i, _)| z[i] - mean);
        // Columns without their mean: the piston is free.
        let mut blocks = Vec::new();
        for tool in tools {
            let mut b = columns_by_definition(tool.tif, tool.path);
            for mut column in b.columns_mut() {
                let mean = column.sum() / pixels;
                column -= mean;
            }
            blocks.push(b);
        }
        let views: Vec<ArrayView2<f64>> = blocks.iter().map(|b| b.view()).collect();
        let b: Array2<f64> = ndarray::concatenate(ndarray::Axis(1), &views).unwrap();
        let mut h = b.t().dot(&b);
        let mut g: Vec<f64> = b.t().dot(&z).into_raw_vec_and_offset().0;
        let mut first = 0;
        for (tool, own) in tools.iter().zip(&blocks) {
            let n = tool.path.len();
            let energies = own.columns().into_iter().map(|c| c.dot(&c));
            let strongest = energies.fold(0.0, f64::max);
            let columns = patches(&Columns::Point.places(tool.path, tool.tif), tool.tif, &grid());
            let weights = (settings.tikhonov, settings.slope_weight);
            let one = Array2::ones(grid().shape());
            let penalty = Penalty::new(tool.path, tool.tif, &columns, &one, strongest, weights);
            for j in 0..n {
                let mut unit = vec![0.0; n];
                unit[j] = 1.0;
                let column = penalty.gradient(&unit, &vec![0.0; n]);
                (0..n).for_each(|i| h[[first + i, first + j]] += column[i]);
                g[first + j] -= tool.time_weight_nm2_per_s * pixels;
            }
            first += n;
        }
        Self { h, g, constant: 0.5 * z.iter().map(|z| z * z).sum::<f64>() }
    }

    fn value(&self, x: &[f64]) -> f64 {
        let x = ndarray::ArrayView1::from(x);
        let g = ndarray::ArrayView1::from(&self.g);
        0.5 * x.dot(&self.h.dot(&x)) - g.dot(&x) + self.constant
    }
}

#[test]
fn two_tools_of_200_columns_have_the_minimum_of_the_dense_program() {
    let (narrow, wide) = (bell(2.5, 8.0), bell(6.0, 11.0));
    let fine = raster([0.0, 0.0], [12.0, 11.0], 1.0);
    let coarse = raster([-1.0, -1.0], [14.0, 10.0], 2.0);
    assert_eq!(fine.len() + coarse.len(), 202);
    let tools = [tool("narrow", &narrow, &fine, 0.02), tool("wide", &wide, &coarse, 0.01)];
    let settings = to_rounding();
    let solution = solve_several(&surface(waves()), &tools, None, &settings).unwrap();
    let dense = DenseProgram::new(&waves(), &tools, &settings);
    let least = nnls(&dense.h, &dense.g, 1e-13, 10_000, |_| ());
    assert!(least.converged);
    let pixels = waves().len() as f64;
    let minimum = dense.value(&least.value) / pixels;
    let objective = solution.report.objective_nm2;
    // The wanted accuracy; rounding of sums of 1800 squares is 1e-13.
    assert!((objective / minimum - 1.0).abs() < 1e-9, "{objective} {minimum}");
    let t = times(&solution);
    // What the returned times are worth by definition; rounding as above.
    assert!((dense.value(&t) / pixels / minimum - 1.0).abs() < 1e-9);
    let largest = least.value.iter().copied().fold(0.0, f64::max);
    let apart = t.iter().zip(&least.value).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    // Rounding 1e-16 times the condition of H, some 1e7.
    assert!(apart < 1e-9 * largest.max(1.0), "{apart} {largest}");
    // Both work, both stand still somewhere.
    for share in &solution.shares {
        assert!(share.total_time_s > 1.0 && share.at_lower_bound > 0, "{share:?}");
    }
    let total: f64 = solution.shares.iter().map(|share| share.total_time_s).sum();
    // Rounding of sums of 200 times.
    assert!((solution.report.total_time_s / total - 1.0).abs() < 1e-13);
}

#[test]
fn the_gap_bounds_the_distance_from_the_dense_minimum_before_the_end() {
    let (narrow, wide) = (bell(2.5, 8.0), bell(6.0, 11.0));
    let fine = raster([0.0, 0.0], [12.0, 9.0], 1.0);
    let coarse = raster([-1.0, -1.0], [14.0, 10.0], 2.0);
    let tools = [tool("narrow", &narrow, &fine, 0.02), tool("wide", &wide, &coarse, 0.01)];
    for relative_gap in [0.3, 1e-2, 1e-4] {
        let settings = BoundedSettings { relative_gap, ..to_rounding() };
        let solution = solve_several(&surface(waves()), &tools, None, &settings).unwrap();
        let gap = solution.report.proven.relative_gap.unwrap();
        let dense = DenseProgram::new(&waves(), &tools, &settings);
        let least = nnls(&dense.h, &dense.g, 1e-13, 10_000, |_| ());
        let minimum = dense.value(&least.value);
        let value = dense.value(&times(&solution));
        // A proven gap never is too small, but for rounding of sums of 1800 squares.
        assert!(value - minimum <= gap * value + 1e-12 * value, "{gap} {value} {minimum}");
        assert!(
            gap <= relative_gap && solution.report.end == End::Optimal,
            "{:?}",
            solution.report
        );
    }
}

/// With t_1 = t_2 = t / 2 the penalty of two equal tools is half of that of one; no other split has less.
#[test]
fn one_tool_given_twice_is_that_tool_once_with_half_the_penalty() {
    let (tif, path) = (bell(2.5, 8.0), raster([0.0, 0.0], [12.0, 9.0], 1.0));
    let desired = surface(waves());
    let settings = to_rounding();
    let twice = [tool("one", &tif, &path, 0.02), tool("other", &tif, &path, 0.02)];
    let twice = solve_several(&desired, &twice, None, &settings).unwrap();
    let half = BoundedSettings {
        tikhonov: 0.5 * settings.tikhonov,
        slope_weight: 0.5 * settings.slope_weight,
        time_weight_nm2_per_s: 0.02,
        ..settings
    };
    let once = solve(&desired, &tif, &path, None, &half).unwrap();
    let [a, b] = [twice.report.objective_nm2, once.report.objective_nm2];
    // Rounding of sums of 1800 squares, and of the gradient at which both end.
    assert!((a / b - 1.0).abs() < 1e-9, "{a} {b}");
    for (j, t) in once.dwell.dwell_s().iter().enumerate() {
        let sum = twice.dwell[0].dwell_s()[j] + twice.dwell[1].dwell_s()[j];
        // Rounding 1e-16 times the condition of H, some 1e7, times seconds.
        assert!((sum - t).abs() < 1e-8, "{j}: {sum} {t}");
    }
}

#[test]
fn one_tool_alone_is_the_solver_of_one_tool_to_the_last_bit() {
    let (tif, path) = (bell(2.5, 8.0), raster([0.0, 0.0], [12.0, 9.0], 1.0));
    let desired = surface(waves());
    let settings = BoundedSettings { time_weight_nm2_per_s: 0.02, ..BoundedSettings::default() };
    let one = [tool("one", &tif, &path, 0.02)];
    let several = solve_several(&desired, &one, None, &settings).unwrap();
    let alone = solve(&desired, &tif, &path, None, &settings).unwrap();
    assert_eq!(several.dwell[0], alone.dwell);
}

#[test]
fn what_two_tools_removed_leaves_nothing() {
    let (narrow, wide) = (bell(2.5, 8.0), bell(6.0, 11.0));
    let fine = raster([0.0, 0.0], [12.0, 9.0], 1.0);
    let coarse = raster([-1.0, -1.0], [14.0, 10.0], 2.0);
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut removal = Array2::zeros(grid().shape());
    let mut planted = Vec::new();
    for (tif, path) in [(&narrow, &fine), (&wide, &coarse)] {
        let b = columns_by_definition(tif, path);
        for column in b.columns() {
            let t = rng.random_range(0.2..2.0);
            planted.push(t);
            let map = column.to_shape(grid().shape()).unwrap();
            removal.scaled_add(t, &map);
        }
    }
    let tools = [tool("narrow", &narrow, &fine, 0.0), tool("wide", &wide, &coarse, 0.0)];
    let weak = BoundedSettings { tikhonov: 1e-9, slope_weight: 0.0, ..to_rounding() };
    let solution = solve_several(&surface(removal.clone()), &tools, None, &weak).unwrap();
    // The minimum is at most the value at the planted times: their penalty.
    let dense = DenseProgram::new(&removal, &tools, &weak);
    let most = dense.value(&planted) / removal.len() as f64;
    let report = &solution.report;
    // Rounding of the residual of sums of 1e3 nm.
    let rounding = 1e-10;
    assert!(report.model_rms_nm <= (2.0 * most).sqrt() + rounding, "{report:?} {most}");
    assert!(report.model_rms_nm < 1e-3, "{report:?}");
}

/// Mirror images of each other on a mirrored map, without a common pixel: each half has the same piston, so that the
/// plan is that of one half, twice.
#[test]
fn tools_without_a_common_pixel_decouple() {
    let tif = bell(1.5, 8.0);
    let left = raster([1.5, 1.0], [2.5, 7.0], 0.5);
    let mirrored: Vec<[f64; 2]> = left.point_mm().iter().map(|p| [12.0 - p[0], p[1]]).collect();
    let n = left.len();
    let right = ToolPath::through(mirrored, vec![true; n], vec![0; n]).unwrap();
    let g = grid();
    let one = waves();
    let nx = g.x.len();
    // The column in the middle belongs to neither half.
    let whole = Array2::from_shape_fn(g.shape(), |(r, c)| match c.min(nx - 1 - c) {
        c if c == nx / 2 => f64::NAN,
        c => one[[r, c]],
    });
    let mut half = whole.clone();
    half.slice_mut(s![.., nx / 2..]).fill(f64::NAN);
    let settings = BoundedSettings { slope_weight: 0.0, ..to_rounding() };
    let tools = [tool("left", &tif, &left, 0.02), tool("right", &tif, &right, 0.02)];
    let both = solve_several(&surface(whole.clone()), &tools, None, &settings).unwrap();
    // The weights of the penalty are relative to the map, which has twice the pixels.
    let alpha = |map: &Array2<f64>| {
        let weight = map.mapv(|z| if z.is_nan() { 0.0 } else { 1.0 });
        let total = weight.sum();
        let columns = patches(&Columns::Point.places(&left, &tif), &tif, &g);
        let energy = columns.iter().map(|p| {
            let ((r, c), (ny, nx)) = (p.origin, p.rate_nm_per_s.dim());
            let counted = &p.rate_nm_per_s * &weight.slice(s![r..r + ny, c..c + nx]);
            counted.mapv(|v| v * v).sum() - counted.sum().powi(2) / total
        });
        let strongest = energy.fold(0.0, f64::max);
        Penalty::new(&left, &tif, &columns, &weight, strongest, (1.0, 0.0)).alpha[0]
    };
    let tikhonov = settings.tikhonov * alpha(&whole) / alpha(&half);
    // A second counts for each of the pixels, of which the half has half as many.
    let of_half = BoundedSettings { tikhonov, time_weight_nm2_per_s: 0.04, ..settings };
    let alone = solve(&surface(half), &tif, &left, None, &of_half).unwrap();
    for j in 0..n {
        let expected = alone.dwell.dwell_s()[j];
        for dwell in &both.dwell {
            // Rounding 1e-16 times the condition of H, some 1e6, times seconds.
            assert!((dwell.dwell_s()[j] - expected).abs() < 1e-8, "{j} {expected} {dwell:?}");
        }
    }
}

#[test]
fn a_tool_less_never_lowers_the_minimum() {
    let tifs = [bell(2.0, 8.0), bell(4.0, 6.0), bell(7.0, 11.0)];
    let paths = [
        raster([0.0, 0.0], [12.0, 9.0], 0.75),
        raster([-1.0, -1.0], [14.0, 11.0], 1.5),
        raster([-2.0, -2.0], [16.0, 13.0], 2.5),
    ];
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    for case in 0..4 {
        let mut height = waves();
        height.mapv_inplace(|z| z + rng.random_range(-1.0..1.0));
        let desired = surface(height);
        let rack: Vec<ToolTask<'_>> = (0..3)
            .map(|k| {
                let name = ["fine", "middle", "coarse"][k];
                tool(name, &tifs[k], &paths[k], 0.01 * rng.random_range(0.0..3.0))
            })
            .collect();
        let mut least = [f64::INFINITY; 8];
        for subset in 1..8_usize {
            let tools = of_subset(&rack, subset);
            let solution =
                solve_several(&desired, &tools, None, &BoundedSettings::default()).unwrap();
            assert_eq!(solution.report.end, End::Optimal, "{case} {subset}");
            least[subset] = solution.report.objective_nm2;
        }
        for subset in 1..8_usize {
            for k in (0..3).filter(|k| subset >> k & 1 == 1) {
                let fewer = least[subset & !(1 << k)];
                // Each is known to its gap of 1e-4.
                assert!(least[subset] <= fewer * (1.0 + 1e-4), "{case} {subset} {k}: {least:?}");
            }
        }
        // The tools differ: together they are better than each alone.
        let alone = least[1].min(least[2]).min(least[4]);
        assert!(least[7] < 0.99 * alone, "{case}: {least:?}");
    }
}

/// Returns the tools of a subset, of which bit k says whether tool k is in it.
fn of_subset<T: Copy>(rack: &[T], subset: usize) -> Vec<T> {
    (0..rack.len()).filter(|k| subset >> k & 1 == 1).map(|k| rack[k]).collect()
}

#[test]
fn the_choice_is_that_of_all_seven_subsets() {
    let tifs = [bell(2.0, 8.0), bell(4.0, 6.0), bell(7.0, 11.0)];
    let paths = [
        raster([0.0, 0.0], [12.0, 9.0], 0.75),
        raster([-1.0, -1.0], [14.0, 11.0], 1.5),
        raster([-2.0, -2.0], [16.0, 13.0], 2.5),
    ];
    let desired = surface(waves());
    let settings = BoundedSettings::default();
    let mut sizes = [0; 4];
    for changes_nm2 in [[0.0; 3], [0.05; 3], [0.5; 3], [20.0; 3], [0.5, 0.0, 0.3]] {
        let rack: Vec<RackTool<'_>> = (0..3)
            .map(|k| {
                let name = ["fine", "middle", "coarse"][k];
                let task = tool(name, &tifs[k], &paths[k], 0.01);
                RackTool { task, change_nm2: changes_nm2[k] }
            })
            .collect();
        let choice = choose_tools(&desired, &rack, None, &settings, |_| ()).unwrap();
        let mut least = (f64::INFINITY, Vec::new());
        for subset in 1..8 {
            let tools = of_subset(&rack, subset);
            let tasks: Vec<ToolTask<'_>> = tools.iter().map(|tool| tool.task).collect();
            let solution = solve_several(&desired, &tasks, None, &settings).unwrap();
            let changes: f64 = tools.iter().map(|tool| tool.change_nm2).sum();
            let cost = solution.report.objective_nm2 + changes;
            println!("{changes_nm2:?} {subset:03b}: {cost} nm^2");
            if cost < least.0 {
                least = (cost, of_subset(&[0, 1, 2], subset));
            }
        }
        let best = &choice.solved[choice.best];
        assert_eq!(best.tools, least.1, "{changes_nm2:?}");
        // The same problem, solved by the same steps.
        assert_eq!(best.cost_nm2, least.0);
        // The gap of each problem.
        let gap = (best.cost_nm2 - choice.bound_nm2) / best.cost_nm2;
        assert!((0.0..=1e-4).contains(&gap), "{gap}");
        println!("{changes_nm2:?}: {} problems, {:?}", choice.solved.len(), best.tools);
        assert!(choice.solved.len() <= 5, "{changes_nm2:?}: {}", choice.solved.len());
        sizes[best.tools.len()] += 1;
    }
    // One, two and three tools are each the best once.
    assert!(sizes[1..].iter().all(|count| *count > 0), "{sizes:?}");
}

/// With a free choice of the price, a tool alone can take any time. At the time of the plan of all tools it leaves no
/// less.
#[test]
fn twenty_random_racks_are_never_worse_than_a_tool_alone_at_the_same_time() {
    let mut rng = ChaCha8Rng::seed_from_u64(20);
    // The penalty belongs to the objective, too, so that a weak one compares residuals and times alone. With the
    // weights of the default, a plan of two tools of nearly one width leaves up to 1 % more.
    let default = BoundedSettings::default();
    let settings = BoundedSettings {
        tikhonov: 1e-3 * default.tikhonov,
        slope_weight: 1e-3 * default.slope_weight,
        ..default
    };
    let mut compared = 0;
    for case in 0..20 {
        let waves = rng.random_range(0.5..2.0);
        let height = Array2::from_shape_fn(grid().shape(), |(r, c)| {
            let (x, y) = (grid().x.coordinate_mm(c), grid().y.coordinate_mm(r));
            60.0 + 20.0 * (0.5 * x).cos() * (0.3 * y).sin() + 5.0 * (waves * x + 0.7 * y).sin()
        });
        let desired = surface(height);
        let radii_mm: Vec<f64> =
            (0..2 + case % 2).map(|_| 0.25 * f64::from(rng.random_range(8..28))).collect();
        let tifs: Vec<Tif> =
            radii_mm.iter().map(|radius| bell(*radius, rng.random_range(2.0..20.0))).collect();
        let paths: Vec<ToolPath> = radii_mm
            .iter()
            .map(|radius| raster([-1.0, -1.0], [14.0, 11.0], (radius / 2.5).clamp(0.75, 3.0)))
            .collect();
        let names = ["a", "b", "c"];
        let price = 10_f64.powf(rng.random_range(-3.0..-1.0));
        let rack: Vec<RackTool<'_>> = (0..tifs.len())
            .map(|k| {
                let task = tool(names[k], &tifs[k], &paths[k], price);
                RackTool { task, change_nm2: 0.0 }
            })
            .collect();
        let choice = choose_tools(&desired, &rack, None, &settings, |_| ()).unwrap();
        let plan = &choice.best().solution.report;
        let time_s = plan.total_time_s;
        for single in &rack {
            // Bisection by the logarithm of the price: a larger one shortens the time.
            let mut log_price = [-9.0, 3.0];
            let mut best_nm: Option<(f64, f64)> = None;
            for _ in 0..14 {
                let middle = 0.5 * (log_price[0] + log_price[1]);
                let task = ToolTask { time_weight_nm2_per_s: 10_f64.powf(middle), ..single.task };
                let alone = solve_several(&desired, &[task], None, &settings).unwrap().report;
                if alone.total_time_s > time_s {
                    log_price[0] = middle;
                } else {
                    log_price[1] = middle;
                    best_nm = Some((alone.model_rms_nm, alone.total_time_s));
                }
            }
            // A tool whose least time is longer leaves nothing to compare.
            let Some((rms_nm, alone_s)) = best_nm else { continue };
            compared += 1;
            // The gap of 1e-4 of the objective, which also has the penalty and the time.
            assert!(
                plan.model_rms_nm <= 1.001 * rms_nm,
                "{case} {radii_mm:?}: {} nm in {time_s} s, {rms_nm} nm in {alone_s} s by {:?} alone",
                plan.model_rms_nm,
                single.task.name
            );
        }
    }
    println!("{compared} comparisons");
    assert!(compared >= 40, "{compared}");
}

/// Returns a number of a normal distribution with this standard deviation, nearly: a sum of twelve uniform ones.
fn normal(rng: &mut ChaCha8Rng, deviation: f64) -> f64 {
    deviation * (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>()
}

/// Returns the errors of the coarse tool in the tests: 0.3 mm along x and y, and 3 % of its rate.
fn setup_of_coarse(measured_after: bool) -> SetupErrors {
    SetupErrors { shift_mm: [0.3, 0.3], rate_fraction: 0.03, measured_after }
}

/// Returns the plan of one tool with the least residual in at most this time: bisection by the logarithm of its price.
fn within_time(desired: &Surface, task: ToolTask<'_>, most_s: f64) -> BoundedReport {
    let settings = BoundedSettings { columns: Columns::Point, ..BoundedSettings::default() };
    let mut log_price = [-6.0, 0.0];
    let mut best = None;
    for _ in 0..12 {
        let middle = 0.5 * (log_price[0] + log_price[1]);
        let task = ToolTask { time_weight_nm2_per_s: 10_f64.powf(middle), ..task };
        let report = solve_several(desired, &[task], None, &settings).unwrap().report;
        if report.total_time_s > most_s {
            log_price[0] = middle;
        } else {
            log_price[1] = middle;
            best = Some(report);
        }
    }
    best.expect("a price of 1 nm^2/s leaves little time")
}

/// Returns the 20th and the 38th of 40 values: half and 95 % are at most as large.
fn half_and_most(mut values: Vec<f64>) -> [f64; 2] {
    values.sort_by(f64::total_cmp);
    assert_eq!(values.len(), 40);
    [values[19], values[37]]
}

/// The coarse tool runs 0.3 mm off along x and y, and its rate is off by 3 % (standard deviations). With the map that is
/// measured after it, the fine tool is planned again and keeps the residual of the plan. Its reserve says how long that
/// takes. Without one the same time leaves more.
#[test]
fn a_map_between_the_tools_mends_the_set_up_errors_of_the_coarse_one() {
    let (narrow, wide) = (bell(2.5, 8.0), bell(6.0, 11.0));
    let fine = raster([-1.0, -1.0], [14.0, 11.0], 0.75);
    let coarse = raster([-1.0, -1.0], [14.0, 10.0], 2.0);
    let bare = [tool("wide", &wide, &coarse, 0.01), tool("narrow", &narrow, &fine, 0.01)];
    let reserving = [ToolTask { setup: setup_of_coarse(true), ..bare[0] }, bare[1]];
    let settings = BoundedSettings { columns: Columns::Point, ..BoundedSettings::default() };
    let desired = surface(waves());
    let without = solve_several(&desired, &bare, None, &settings).unwrap();
    let plan = solve_several(&desired, &reserving, None, &settings).unwrap();
    let reserve = plan.shares[1].reserve.clone().expect("the coarse tool has errors");
    let [planned_s, without_s] = [&plan, &without].map(|plan| plan.shares[1].total_time_s);
    let more_s = plan.report.total_time_s - without.report.total_time_s;
    let mut rng = ChaCha8Rng::seed_from_u64(40);
    // Residual over that of the plan, and time of the fine tool.
    let [mut kept, mut kept_s, mut blind, mut same_price, mut same_time, mut uniform] =
        [const { Vec::new() }; 6];
    for _ in 0..40 {
        let shift_mm = [normal(&mut rng, 0.3), normal(&mut rng, 0.3)];
        let rate_fraction = normal(&mut rng, 0.03);
        let draws = [SetupDraw { shift_mm, rate_fraction }, SetupDraw::default()];
        let run = |tools: &[ToolTask<'_>], plan: &SeveralSolution, has_maps| {
            let problem = (&desired, None, &settings);
            execute_with_errors(problem, tools, plan, &draws, has_maps).unwrap()
        };
        let with_map = run(&reserving, &plan, true);
        assert!(with_map.is_kept, "{with_map:?}");
        kept.push(with_map.rms_nm / plan.report.model_rms_nm);
        kept_s.push(with_map.time_s[1]);
        blind.push(run(&bare, &without, false).rms_nm / without.report.model_rms_nm);
        // The map after the coarse tool of the plan without a reserve.
        let points = coarse.point_mm().iter();
        let off = points.map(|p| [p[0] + shift_mm[0], p[1] + shift_mm[1]]).collect();
        let n = coarse.len();
        let off = ToolPath::through(off, vec![true; n], vec![0; n]).unwrap();
        let b = columns_by_definition(&wide, &off);
        let removal = b.dot(&ndarray::ArrayView1::from(without.dwell[0].dwell_s()));
        let removal = removal.to_shape(grid().shape()).unwrap().to_owned();
        let measured = surface(waves() - removal * (1.0 + rate_fraction));
        let again = solve_several(&measured, &bare[1..], None, &settings).unwrap().report;
        same_price.push(again.model_rms_nm / without.report.model_rms_nm);
        for (time_s, ratios) in [(without_s, &mut same_time), (without_s + more_s, &mut uniform)] {
            let again = within_time(&measured, bare[1], time_s);
            ratios.push(again.model_rms_nm / without.report.model_rms_nm);
        }
    }
    let [kept, kept_s, blind, same_price, same_time, uniform] =
        [kept, kept_s, blind, same_price, same_time, uniform].map(half_and_most);
    println!(
        "reserve {:.2} nm (at most {:.2} nm), {more_s:.1} s more than {:.1} s in all; plan {:.4} nm, without a reserve \
         {:.4} nm. Residual over that of the plan in half and in 95 % of 40 draws:",
        reserve.mean_nm,
        reserve.largest_nm,
        without.report.total_time_s,
        plan.report.model_rms_nm,
        without.report.model_rms_nm
    );
    println!("reserve, map between: {kept:.3?} in {kept_s:.1?} s of {planned_s:.1} s planned");
    println!("no reserve, map between, planned time of {without_s:.1} s: {same_time:.3?}");
    println!("no reserve, map between, price of the plan: {same_price:.3?}");
    println!("uniform layer of the same time, map between, all of it used: {uniform:.3?}");
    println!("no map between: {blind:.3?}");
    // The goal: within 10 % of the plan in 95 % of the draws, and in the time that the plan reserves.
    assert!(kept[1] <= 1.1, "{kept:?}");
    assert!(kept_s[1] <= planned_s, "{kept_s:?} {planned_s}");
    // Without a reserve the planned time does not suffice.
    assert!(same_time[0] > 1.1 && blind[0] > same_time[0], "{same_time:?} {blind:?}");
}

#[test]
fn a_reserve_is_two_deviations_of_the_tool_before() {
    let (narrow, wide) = (bell(2.5, 8.0), bell(6.0, 11.0));
    let fine = raster([-1.0, -1.0], [14.0, 11.0], 0.75);
    let coarse = raster([-1.0, -1.0], [14.0, 10.0], 2.0);
    let rate_alone =
        SetupErrors { rate_fraction: 0.05, measured_after: true, ..SetupErrors::default() };
    let bare = [tool("narrow", &narrow, &fine, 0.01), tool("wide", &wide, &coarse, 0.01)];
    let tools = [bare[0], ToolTask { setup: rate_alone, ..bare[1] }];
    let settings = BoundedSettings { columns: Columns::Point, ..BoundedSettings::default() };
    let desired = surface(waves());
    let without = solve_several(&desired, &bare, None, &settings).unwrap();
    let plan = solve_several(&desired, &tools, None, &settings).unwrap();
    // The wide tool works first, wherever it stands in the rack.
    assert!(plan.shares[1].reserve.is_none() && plan.unseen_rms_nm.is_none());
    let reserve = plan.shares[0].reserve.clone().unwrap();
    assert_eq!(reserve.errors_of, ["wide"]);
    // sigma = 0.05 m, so that its mean is that of m. Rounding of sums of 1800 pixels.
    let expected_nm = 2.0 * 0.05 * without.shares[1].mean_removal_nm;
    assert!((reserve.mean_nm / expected_nm - 1.0).abs() < 1e-12, "{reserve:?} {expected_nm}");
    // l_j a_j / V is the removal of a tool that dwells for l_j: within the ripple and the edges of its raster.
    let b = columns_by_definition(&narrow, &fine);
    let fine_nm = b.dot(&ndarray::ArrayView1::from(plan.dwell[0].dwell_s()));
    let b = columns_by_definition(&wide, &coarse);
    let coarse_nm = b.dot(&ndarray::ArrayView1::from(without.dwell[1].dwell_s()));
    let least = fine_nm.iter().zip(&coarse_nm).map(|(own, other)| own / (0.1 * other));
    let least = least.fold(f64::INFINITY, f64::min);
    // The bell smooths sigma over its 2.5 mm, and the bounds of its points beyond the map are those at the edge.
    assert!(least > 0.8, "{least}");
    // The reserve is a bound on the plan, so that the objective does not fall.
    let [with_nm2, without_nm2] = [&plan, &without].map(|plan| plan.report.objective_nm2);
    assert!(with_nm2 >= without_nm2 * (1.0 - 1e-4), "{with_nm2} {without_nm2}");
    // Without errors in the draw, the plan is what remains.
    let none = [SetupDraw::default(); 2];
    let run =
        execute_with_errors((&desired, None, &settings), &tools, &plan, &none, false).unwrap();
    // Rounding of sums of 1800 squares of residuals that are differences of 30 nm.
    assert!((run.rms_nm / plan.report.model_rms_nm - 1.0).abs() < 1e-9, "{run:?}");
}

#[test]
fn a_reserve_above_the_upper_bound_is_refused() {
    let (narrow, wide) = (bell(2.5, 8.0), bell(6.0, 11.0));
    let fine = raster([-1.0, -1.0], [14.0, 11.0], 0.75);
    let coarse = raster([-1.0, -1.0], [14.0, 10.0], 2.0);
    let wide = ToolTask { setup: setup_of_coarse(true), ..tool("wide", &wide, &coarse, 0.01) };
    let narrow =
        ToolTask { max_dwell: Some(Bound::Seconds(0.05)), ..tool("narrow", &narrow, &fine, 0.01) };
    let settings = BoundedSettings::default();
    let error = solve_several(&surface(waves()), &[wide, narrow], None, &settings).unwrap_err();
    let expected = "that the reserve for the set-up errors of wide asks for";
    assert!(error.to_string().contains("tool \"narrow\": max_dwell["), "{error}");
    assert!(error.to_string().contains(expected), "{error}");
}

#[test]
fn errors_that_no_map_shows_add_their_expected_square_to_the_dense_program() {
    let (narrow, wide) = (bell(2.5, 8.0), bell(6.0, 11.0));
    let fine = raster([0.0, 0.0], [12.0, 9.0], 1.0);
    let coarse = raster([-1.0, -1.0], [14.0, 10.0], 2.0);
    let setup = SetupErrors { shift_mm: [0.2, 0.4], rate_fraction: 0.05, measured_after: false };
    let tools = [
        tool("narrow", &narrow, &fine, 0.02),
        ToolTask { setup, ..tool("wide", &wide, &coarse, 0.01) },
    ];
    let settings = to_rounding();
    let solution = solve_several(&surface(waves()), &tools, None, &settings).unwrap();
    let mut dense = DenseProgram::new(&waves(), &tools, &settings);
    let b = columns_by_definition(&wide, &coarse);
    let (ny, nx) = grid().shape();
    // Central differences along x and y over the pixels of 0.25 mm, one-sided at the borders.
    let difference = |along_x: bool| {
        Array2::from_shape_fn(b.dim(), |(i, j)| {
            let (r, c) = (i / nx, i % nx);
            let (place, end) = if along_x { (c, nx - 1) } else { (r, ny - 1) };
            let (before, after) = (place.saturating_sub(1), (place + 1).min(end));
            let value = |k| if along_x { b[[r * nx + k, j]] } else { b[[k * nx + c, j]] };
            (value(after) - value(before)) / (0.25 * (after - before) as f64)
        })
    };
    let n = fine.len();
    let mut q = Array2::<f64>::zeros((coarse.len(), coarse.len()));
    for (size, mut field) in [(0.05, b.clone()), (0.2, difference(true)), (0.4, difference(false))]
    {
        for mut column in field.columns_mut() {
            let mean = column.sum() / (nx * ny) as f64;
            column -= mean;
        }
        q.scaled_add(size * size, &field.t().dot(&field));
    }
    let mut block = dense.h.slice_mut(s![n.., n..]);
    block += &q;
    let least = nnls(&dense.h, &dense.g, 1e-13, 10_000, |_| ());
    assert!(least.converged);
    let minimum = dense.value(&least.value) / (nx * ny) as f64;
    let objective = solution.report.objective_nm2;
    // As without the term: rounding of sums of 1800 squares.
    assert!((objective / minimum - 1.0).abs() < 1e-9, "{objective} {minimum}");
    let t = ndarray::ArrayView1::from(solution.dwell[1].dwell_s());
    let expected_nm = (t.dot(&q.dot(&t)) / (nx * ny) as f64).sqrt();
    let stated_nm = solution.unseen_rms_nm.unwrap();
    assert!((stated_nm / expected_nm - 1.0).abs() < 1e-9, "{stated_nm} {expected_nm}");
}

#[test]
fn a_residual_is_kept_at_the_largest_price_that_keeps_it() {
    let (tif, path) = (bell(2.5, 8.0), raster([-1.0, -1.0], [14.0, 11.0], 0.75));
    let desired = surface(waves());
    let settings = BoundedSettings::default();
    let task = tool("one", &tif, &path, 0.05);
    let as_priced = solve_several(&desired, &[task], None, &settings).unwrap().report;
    let keep_nm = 0.5 * as_priced.model_rms_nm;
    let plan = solve_keeping(&desired, &[task], None, &settings, keep_nm).unwrap();
    let rms_nm = plan.solution.report.model_rms_nm;
    assert!(plan.is_kept && rms_nm <= keep_nm && rms_nm >= 0.98 * keep_nm, "{rms_nm} {keep_nm}");
    let dearer = ToolTask { time_weight_nm2_per_s: 1.3 * plan.price_factor * 0.05, ..task };
    let dearer = solve_several(&desired, &[dearer], None, &settings).unwrap().report;
    assert!(dearer.model_rms_nm > keep_nm, "{} {keep_nm}", dearer.model_rms_nm);
    // What is kept as it is keeps its price, and what no price keeps says so.
    let easy = solve_keeping(&desired, &[task], None, &settings, 1.01 * as_priced.model_rms_nm);
    let easy = easy.unwrap();
    assert!(easy.is_kept && easy.price_factor == 1.0);
    let never = solve_keeping(&desired, &[task], None, &settings, 1e-9).unwrap();
    assert!(!never.is_kept && never.price_factor < 1e-3, "{}", never.price_factor);
    let error = solve_keeping(&desired, &[task], None, &settings, 0.0).unwrap_err();
    assert!(error.to_string().contains("keep_rms_nm: is 0; give a number > 0"), "{error}");
}

#[test]
fn a_rack_without_a_choice_is_refused() {
    let (tif, path) = (bell(2.5, 8.0), raster([0.0, 0.0], [12.0, 9.0], 1.0));
    let task = tool("good", &tif, &path, 0.0);
    let one = RackTool { task, change_nm2: 0.0 };
    let cases = [
        (vec![], "rack: has 0 tools"),
        (vec![one; 7], "rack: has 7 tools"),
        (vec![RackTool { change_nm2: -1.0, ..one }], "change_nm2[0]: is -1 for tool \"good\""),
    ];
    for (rack, expected) in cases {
        let settings = BoundedSettings::default();
        let error = choose_tools(&surface(waves()), &rack, None, &settings, |_| ()).unwrap_err();
        assert!(error.to_string().contains(expected), "{error} / {expected}");
    }
}

#[test]
fn mistakes_are_refused_with_the_name_of_the_tool() {
    let (tif, path) = (bell(2.5, 8.0), raster([0.0, 0.0], [12.0, 9.0], 1.0));
    let weak = bell(2.5, 7e-6);
    let far = raster([100.0, 0.0], [12.0, 9.0], 1.0);
    let good = tool("good", &tif, &path, 0.0);
    let reversed =
        ToolTask { min_dwell: Bound::Seconds(2.0), max_dwell: Some(Bound::Seconds(1.0)), ..good };
    let cases: [(&[ToolTask<'_>], &str); 7] = [
        (&[], "tools: are none"),
        (&[good, good], "tools[1]: is a second tool \"good\""),
        (
            &[good, tool("weak", &weak, &path, 0.0)],
            "\"weak\") and 8e0 nm/s (\"good\"), more than a factor of 1e6",
        ),
        (&[good, tool("far", &tif, &far, 0.0)], "tool \"far\": none of the 129 dwell points"),
        (&[good, tool("dear", &tif, &path, -1.0)], "tool \"dear\": time_weight_nm2_per_s: is -1"),
        (
            &[good, tool("paid", &tif, &path, f64::NAN)],
            "tool \"paid\": time_weight_nm2_per_s: is NaN",
        ),
        (
            &[ToolTask { name: "reversed", ..reversed }, good],
            "tool \"reversed\": max_dwell[0]: is 1 s, below",
        ),
    ];
    for (tools, expected) in cases {
        let error: DwellError =
            solve_several(&surface(waves()), tools, None, &BoundedSettings::default()).unwrap_err();
        assert!(error.to_string().contains(expected), "{error} / {expected}");
    }
}
