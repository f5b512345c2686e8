//! Settings of a reconciliation: free parameters and terms.

use planish_simulate::deviation::TURNS;
use planish_types::Invalid;
use serde::Serialize;

use crate::{
    metrology::{self, Term},
    parameter::{self, Parameter},
};

/// Largest order of Legendre polynomials along an axis. Larger: the metrology takes up what a map measures. Smaller:
/// fewer of its errors can be free. Chosen.
const LARGEST_ORDER: usize = 12;

/// Settings of a reconciliation.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Settings {
    /// Names of the free parameters and terms; all if none is given. If a parameter is named and the data do not
    /// determine it, the verdict is negative.
    pub free: Vec<String>,
    /// Names of the parameters and terms that are held at their values in the plan.
    pub hold: Vec<String>,
    /// Legendre terms of the metrology up to these orders along x and y that are free beside piston, tilt and power.
    pub metrology_order: Option<[usize; 2]>,
    /// True if errors move the TIF with the noise and the border of its measurement.
    pub tif_as_sampled: bool,
    /// True if the user states that both maps were measured and read in the same way: with one sign, one unit and one
    /// orientation of the part. What the maps do not tell of that is then no reason against them.
    pub same_measurement: bool,
}

impl Settings {
    /// The free parameters and terms of the metrology, for a tool that has the parameters `has`.
    pub fn chosen(
        &self,
        has: impl Fn(Parameter) -> bool,
    ) -> Result<(Vec<Parameter>, Vec<Term>), Invalid> {
        let free = parameter::parse("free", &self.free)?;
        let hold = parameter::parse("hold", &self.hold)?;
        if let Some((i, name)) = hold.iter().enumerate().find(|(_, n)| free.contains(n)) {
            let remedy = "a parameter is free or held; leave one out";
            return Err(Invalid::at("hold", i, format!("is {name:?}, which is free"), remedy));
        }
        let absent = |name: &String| Parameter::named(name).is_some_and(|p| !has(p));
        if let Some(i) = free.iter().position(absent) {
            let problem = format!("is {:?}, and the tool {TURNS}", free[i]);
            return Err(Invalid::at("free", i, problem, "leave it out"));
        }
        if let Some(orders) = self.metrology_order
            && let Some(axis) = orders.iter().position(|n| *n > LARGEST_ORDER)
        {
            let remedy = format!("give at most {LARGEST_ORDER}");
            let problem = format!("is {}", orders[axis]);
            return Err(Invalid::at("metrology_order", axis, problem, remedy));
        }
        // Terms of the metrology stay free where parameters are named: no map has the piston of another.
        let named = |name: &str, names: &[String]| names.iter().any(|n| n == name);
        let parameters_named = free.iter().any(|n| Parameter::named(n).is_some());
        let parameters = parameter::ALL
            .into_iter()
            .filter(|p| (!parameters_named || named(p.name(), &free)) && !named(p.name(), &hold))
            .filter(|p| has(*p));
        let terms = metrology::terms(self.metrology_order);
        let terms = terms.into_iter().filter(|t| !named(&t.name(), &hold)).collect();
        Ok((parameters.collect(), terms))
    }
}
