//! Short waves of the maps of a measured mirror.

use planish_numerics::spectrum::without_plane;
use planish_testkit::mirror::mirror;
use planish_types::{Surface, reach::Reach};

#[test]
fn two_thirds_of_the_published_residual_are_short_waves() {
    let Some(mirror) = mirror() else { return };
    let reach = Reach::new(&mirror.desired, &[&mirror.tif]).unwrap();
    // Found by NumPy with the same definition.
    for (name, rms_nm) in [
        ("height_nm", 0.0998),
        ("raster_udo_residual_nm", 0.1656),
        ("after_ibf_measured_nm", 0.0616),
    ] {
        let surface = Surface::new(*mirror.desired.grid(), mirror.map(name)).unwrap();
        let surface = Surface::new(*surface.grid(), {
            let (x, y) = (surface.grid().x.coordinates(), surface.grid().y.coordinates());
            without_plane(surface.height_nm().view(), &x, &y)
        })
        .unwrap();
        let found = reach.short_wave_rms_nm(&surface);
        // Stated to four decimals.
        assert!((found - rms_nm).abs() < 1e-4, "{name}: {found}");
    }
}
