//! The tests that run programs, of every stage, as one test program. The files stand beside the library of their stage.

#[path = "../../app/tests/http.rs"]
mod app_http;
#[path = "../../axes/tests/cli.rs"]
mod axes_cli;
#[path = "../../benchmark/tests/cli.rs"]
mod benchmark_cli;
#[path = "../../bspline-feed/tests/cli.rs"]
mod bspline_feed_cli;
#[path = "../../bspline-feed/tests/hostile.rs"]
mod bspline_feed_hostile;
#[path = "../../campaign/tests/cli.rs"]
mod campaign_cli;
mod commands;
#[path = "../../compare/tests/chain.rs"]
mod compare_chain;
#[path = "../../compare/tests/cli.rs"]
mod compare_cli;
#[path = "../../dwell/tests/cli.rs"]
mod dwell_cli;
#[path = "../../dwell/tests/cli_bound.rs"]
mod dwell_cli_bound;
#[path = "../../dwell/tests/cli_several_tools.rs"]
mod dwell_cli_several_tools;
#[path = "../../dwell/tests/cli_solvers.rs"]
mod dwell_cli_solvers;
#[path = "../../dwell/tests/hostile.rs"]
mod dwell_hostile;
#[path = "../../export/tests/cli.rs"]
mod export_cli;
#[path = "../../export/tests/galil_host.rs"]
mod export_galil_host;
#[path = "../../fixture/tests/cli.rs"]
mod fixture_cli;
#[path = "../../import/tests/cases.rs"]
mod import_cases;
#[path = "../../import/tests/cli.rs"]
mod import_cli;
#[path = "../../import/tests/hostile.rs"]
mod import_hostile;
#[path = "../../joint/tests/cli.rs"]
mod joint_cli;
mod pipeline_lines;
#[path = "../../reconcile/tests/cli.rs"]
mod reconcile_cli;
#[path = "../../refine/tests/hostile.rs"]
mod refine_hostile;
#[path = "../../register/tests/cli.rs"]
mod register_cli;
#[path = "../../run/tests/cli.rs"]
mod run_cli;
#[path = "../../run/tests/cli_several.rs"]
mod run_cli_several;
#[path = "../../run/tests/resume.rs"]
mod run_resume;
#[path = "../../schedule/tests/cli.rs"]
mod schedule_cli;
#[path = "../../schedule/tests/hostile.rs"]
mod schedule_hostile;
#[path = "../../simulate/tests/cli.rs"]
mod simulate_cli;
#[path = "../../simulate/tests/hostile.rs"]
mod simulate_hostile;
#[path = "../../simulate/tests/virtual_machine.rs"]
mod simulate_virtual_machine;
#[path = "../src/stages.rs"]
mod stages;
#[path = "../../surface/tests/cli.rs"]
mod surface_cli;
#[path = "../../surface/tests/forms.rs"]
mod surface_forms;
#[path = "../../surface/tests/hostile.rs"]
mod surface_hostile;
#[path = "../../surface/tests/line.rs"]
mod surface_line;
#[path = "../../sweep/tests/cli.rs"]
mod sweep_cli;
#[path = "../../testkit/tests/as_run.rs"]
mod testkit_as_run;
#[path = "../../testkit/tests/campaign.rs"]
mod testkit_campaign;
#[path = "../../testkit/tests/end_to_end.rs"]
mod testkit_end_to_end;
#[path = "../../testkit/tests/flags.rs"]
mod testkit_flags;
#[path = "../../testkit/tests/machine.rs"]
mod testkit_machine;
#[path = "../../testkit/tests/random_problems.rs"]
mod testkit_random_problems;
#[path = "../../tolerance/tests/cli.rs"]
mod tolerance_cli;
#[path = "../../tolerance/tests/hostile.rs"]
mod tolerance_hostile;
#[path = "../../tool/tests/cli.rs"]
mod tool_cli;
#[path = "../../tool/tests/hostile.rs"]
mod tool_hostile;
#[path = "../../tool/tests/varying.rs"]
mod tool_varying;
#[path = "../../toolpath/tests/cli.rs"]
mod toolpath_cli;
#[path = "../../toolpath/tests/hostile.rs"]
mod toolpath_hostile;
#[path = "../../toolpath/tests/multi_pitch.rs"]
mod toolpath_multi_pitch;
#[path = "../../toolpath/tests/random_adaptive.rs"]
mod toolpath_random_adaptive;
#[path = "../../verify/tests/cli.rs"]
mod verify_cli;
