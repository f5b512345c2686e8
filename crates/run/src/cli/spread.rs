//! `planish campaign-spread`: runs campaigns with several seeds, and shows how their results scatter.

use clap::Args;
use planish_handoff::{Failure, Status};

use super::{
    campaign::campaign,
    execute::{Messages, Programs},
    place::{Installation, directory_name, name_of},
    run::end,
    several::{UserSettings, command, count, log},
};

#[derive(Args)]
pub struct CampaignSpread {
    /// Name of a fixture (coupon without one), seeds=N (20 without it), and settings of `planish campaign`; each
    /// campaign is in out/campaign-spread/MIRROR/SEED, or in OUT/SEED with out=OUT
    #[arg(value_name = "WORD", trailing_var_arg = true, allow_hyphen_values = true)]
    words: Vec<String>,
}

impl CampaignSpread {
    pub fn run(&self) -> Result<Status, Failure> {
        let place = Installation::find()?;
        let mut user = UserSettings::new(&self.words)?;
        if user.get("seed").is_some() {
            return Err(Failure::new(
                "every campaign has a seed of its own; give seeds=N, how many",
            ));
        }
        let seeds = count("seeds", &user.take("seeds").unwrap_or("20".into()), 999)?;
        let fixture = user.take_fixture()?;
        let mirror = match user.get("surface").filter(|path| !path.is_empty()) {
            Some(path) => name_of(&std::path::absolute(path)?),
            None => fixture.clone().unwrap_or("coupon".into()),
        };
        let out = user
            .take_path("out")
            .unwrap_or_else(|| format!("out/campaign-spread/{}", directory_name(&mirror)));
        let mut reports = vec!["spread".to_string()];
        for seed in 1..=seeds {
            let own = [format!("seed={seed}"), format!("out={out}/{seed}")];
            let words = [fixture.as_slice(), &user.settings[..], &own].concat();
            let code = campaign(&words, Messages::Kept(log()?))?;
            if code != 0 {
                return end(code);
            }
            reports.push(format!("{out}/{seed}/report"));
        }
        end(Programs::new(&place, Messages::Shown)?.run(&command("planish-campaign", &reports))?)
    }
}
