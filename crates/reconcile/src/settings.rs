//! Settings of a reconciliation: which parameters and which terms of the metrology are free.

use planish_simulate::deviation::TURNS;
use planish_types::Invalid;
use serde::Serialize;

use crate::{
    metrology::{self, Term},
    parameter::{self, Parameter},
};

/// Largest order of the Legendre polynomials along an axis. Larger: the metrology takes up shapes that a map does
/// measure. Smaller: fewer of its errors can be free. Chosen.
const LARGEST_ORDER: usize = 12;

/// Settings of a reconciliation.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ReconcileSettings {
    /// Names of the free parameters; all parameters if none is named. If a named parameter is not determined by the
    /// data, the verdict is negative. Terms of the metrology may be named, and are free in any case.
    pub free: Vec<String>,
    /// Names of the parameters and terms that are held at their values in the plan.
    pub hold: Vec<String>,
    /// Orders along x and y up to which further Legendre terms of the metrology are free, besides piston, tilt and
    /// power; `None` for no further ones.
    pub metrology_order: Option<[usize; 2]>,
    /// True if the parameters change the TIF as sampled, with the noise and the border step of its measurement.
    pub tif_as_sampled: bool,
    /// True if the user states that both maps were measured and read in the same way: with one sign, one unit and one
    /// orientation of the part. Missing evidence in the maps is then no reason against them.
    pub same_measurement: bool,
}

impl ReconcileSettings {
    /// Returns the free parameters and terms of the metrology, for a tool that has the parameters `has`.
    ///
    /// # Errors
    /// Refuses unknown names, names that are free and held, named parameters that the tool does not have, and an order
    /// above 12.
    pub fn chosen(
        &self,
        has: impl Fn(Parameter) -> bool,
    ) -> Result<(Vec<Parameter>, Vec<Term>), Invalid> {
        let Self { free, hold, .. } = self;
        parameter::check_names("free", free)?;
        parameter::check_names("hold", hold)?;
        if let Some((i, name)) = hold.iter().enumerate().find(|(_, n)| free.contains(n)) {
            let remedy = "a parameter is free or held; leave one out";
            return Err(Invalid::at_index(
                "hold",
                i,
                format!("is {name:?}, which is free"),
                remedy,
            ));
        }
        let absent = |name: &String| Parameter::named(name).is_some_and(|p| !has(p));
        if let Some(i) = free.iter().position(absent) {
            let problem = format!("is {:?}, and the tool {TURNS}", free[i]);
            return Err(Invalid::at_index("free", i, problem, "leave it out"));
        }
        if let Some(orders) = self.metrology_order
            && let Some(axis) = orders.iter().position(|n| *n > LARGEST_ORDER)
        {
            let remedy = format!("give at most {LARGEST_ORDER}");
            let problem = format!("is {}", orders[axis]);
            return Err(Invalid::at_index("metrology_order", axis, problem, remedy));
        }
        // Terms of the metrology stay free where parameters are named: no map has the piston of another.
        let parameters_named = free.iter().any(|n| Parameter::named(n).is_some());
        let mut parameters = parameter::ALL.to_vec();
        parameters.retain(|p| !parameters_named || free.iter().any(|n| n == p.name()));
        parameters.retain(|p| !hold.iter().any(|n| n == p.name()) && has(*p));
        let mut terms = metrology::terms(self.metrology_order);
        terms.retain(|t| !hold.contains(&t.name()));
        Ok((parameters, terms))
    }
}
