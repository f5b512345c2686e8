% What planish.m does, in an empty directory: arrays there and back, calls that write artifacts, and its messages.
% try-matlab.sh compares the bytes with those of NumPy and of the command line.
1;

function refused(call, said)
    try
        call();
    catch problem
        assert(~isempty(strfind(problem.message, said)), problem.message);
        return
    end
    error('%s: was not refused', said);
end

x = -75:0.5:75;
y = -20:0.5:20;
height = 20 + 1e-3 * (x - 10) .^ 2 + 0.05 * y' .^ 2;
height(3, 5) = NaN;
d = -8:0.5:8;
rate = 5 * max(0, 1 - (d .^ 2 + d' .^ 2) / 64) .^ 2;
planish('save', 'mirror', 'height_nm', height, 'x_mm', x, 'y_mm', y);
planish('save', 'tool', 'rate_nm_per_s', rate, 'x_mm', d, 'y_mm', d');
back = planish('load', 'mirror');
assert(isequaln(back.height_nm, height) && isequal(size(back.x_mm), [301, 1]) && isempty(back.manifest));

path = planish('toolpath raster', 'surface', 'mirror', 'tif', 'tool', 'pitch_mm', 2, 'step_mm', 0.8, 'out', 'made/path');
assert(strcmp(path.manifest.kind, 'tool_path') && size(path.point_mm, 2) == 2);
dwell = planish('dwell bounded-least-squares', 'surface', 'mirror', 'tif', 'tool', 'tool_path', path, ...
                'min_dwell_s', 0.02, 'out', 'made/dwell');
assert(numel(dwell.dwell_s) == size(path.point_mm, 1) - 1 && all(dwell.dwell_s >= 0.02));
motion = planish('schedule pvt', 'tool_path', path, 'dwell', dwell, 'machine', 'machine.json', 'out', 'made/trajectory');
% The first axis of a stored array is the first here: segments, axes, powers of time.
assert(isequal(size(motion.coefficient_mm), [numel(motion.break_time_s) - 1, 2, 4]));
verdict = planish('verify', 'trajectory', motion, 'machine', 'machine.json', 'out', 'made/verdict');
assert(isempty(verdict.negative) && verdict.manifest.outcome.limits_respected);
flat = planish('surface prepare', 'surface', 'mirror', 'aperture_rectangle_mm', [-70, 70, -18, 18], 'level', 'plane', ...
               'mask_outliers', true, 'feature_mm', 4, 'out', 'made/prepared');
assert(isequal(size(flat.height_nm), [73, 281]));

refused(@() planish('toolpath raster', 'surface', 'mirror', 'pich_mm', 1), 'no argument ''pich_mm''; there are surface');
refused(@() planish('load', 'nowhere'), 'nowhere: is no directory');
refused(@() planish('save', 'made', 'x_mm', 1:3), 'made: holds something else');
refused(@() planish('save', 'other', 'x_mm', 'text'), 'x_mm: has the type char');
refused(@() planish('polish'), 'planish-polish cannot be run');
refused(@() planish('toolpath zigzag'), 'no command ''zigzag''; there are');
refused(@() planish('toolpath raster', 'surface', 'mirror', 'tif', 'tool', 'pitch_mm', -1, 'step_mm', 1, 'out', 'no'), 'pitch');
refused(@() planish('surface prepare', 'surface', 'mirror', 'mask_outliers', 'yes', 'out', 'no'), 'is a switch');
printf('planish.m: arrays, calls and messages are as they should be\n');
