function result = planish(what, varargin)
%PLANISH Planish from MATLAB and Octave: artifacts as arrays, and every command as a call.
%
%   planish('save', 'mirror', 'height_nm', height, 'x_mm', x, 'y_mm', y);
%   planish('save', 'tool', 'rate_nm_per_s', rate, 'x_mm', dx, 'y_mm', dy);
%   path = planish('toolpath raster', 'surface', 'mirror', 'tif', 'tool', ...
%                  'pitch_mm', 1, 'step_mm', 1, 'out', 'path');
%   dwell = planish('dwell bounded-least-squares', 'surface', 'mirror', 'tif', 'tool', ...
%                   'tool_path', path, 'min_dwell_s', 0.1, 'out', 'dwell');
%   sum(dwell.dwell_s)
%   planish('help', 'dwell bounded-least-squares')
%
%   planish('save', DIR, NAME, ARRAY, ...) writes arrays under their names, with their units, as an artifact: a map
%   is (ny, nx), row 1 at the smallest y, NaN where invalid; vectors have one dimension. DIR must not exist, or be that
%   of an earlier save of the same names.
%
%   planish('load', DIR) is the artifact in DIR as a structure of its arrays, with its manifest, its path, and why the
%   verdict on it is negative (empty when it is not). A dimension of a stored array is the same here; indices begin at 1.
%
%   planish('PROGRAM COMMAND', FLAG, VALUE, ...) runs the program, so that what it writes has the bytes of the command
%   line, and loads what it wrote; without 'out' it is what the program printed. The flag --pitch-mm is 'pitch_mm'. A
%   switch is true or false; several numbers of one flag are a vector; a flag that is given again is a cell array;
%   what the command takes without a flag is a cell array before the first flag. A program that cannot run is an error
%   with its message.
%
%   The programs are those in the folder PLANISH_PROGRAMS of the environment, or in the PATH. They are run by a POSIX
%   shell.
    switch what
        case 'save'
            save_arrays(varargin{:});
        case 'load'
            result = load_artifact(varargin{:});
        case 'help'
            disp(help_text(find_command(varargin{1})));
        otherwise
            result = run_command(find_command(what), varargin);
    end
end

function result = run_command(command, given)
    words = {command.file};
    if ~isempty(command.name)
        words{end + 1} = command.name;
    end
    if mod(numel(given), 2) == 1
        positional = given{1};
        if ~iscell(positional)
            error('planish:argument', 'flags and values come in pairs; what has no flag is a cell array before them');
        end
        words = [words, cellfun(@word, positional(:)', 'UniformOutput', false)];
        given = given(2:end);
    end
    out = '';
    for k = 1:2:numel(given)
        name = strrep(given{k}, '_', '-');
        at = find(cellfun(@(flag) strcmp(flag.name, name), command.flags), 1);
        if isempty(at)
            names = cellfun(@(flag) strrep(flag.name, '-', '_'), command.flags, 'UniformOutput', false);
            error('planish:argument', '%s has no argument ''%s''; there are %s', ...
                  command.title, given{k}, strjoin(names, ', '));
        end
        words = [words, words_of(command.flags{at}, given{k + 1})];
        if strcmp(name, 'out')
            out = word(given{k + 1});
        end
    end
    [code, printed] = run(words);
    if code > 1
        error('planish:program', '%s', regexprep(strtrim(printed), '^error: ', ''));
    end
    if ~isempty(out) && exist(out, 'dir')
        fprintf('%s', printed);
        result = load_made(out);
    else
        result = printed;
    end
end

% The artifact in a folder; of a program that writes several, such as refine, those in it by their names.
function result = load_made(folder)
    if exist(fullfile(folder, 'manifest.json'), 'file')
        result = load_artifact(folder);
        return
    end
    result = struct('path', folder);
    inside = dir(folder);
    for k = 1:numel(inside)
        if exist(fullfile(folder, inside(k).name, 'manifest.json'), 'file')
            result.(inside(k).name) = load_artifact(fullfile(folder, inside(k).name));
        end
    end
end

function [code, printed] = run(words)
    quoted = cellfun(@(w) ['''' strrep(w, '''', '''\''''') ''''], words, 'UniformOutput', false);
    [code, printed] = system([strjoin(quoted, ' ') ' 2>&1']);
end

% The words of one flag.
function words = words_of(flag, value)
    name = ['--' flag.name];
    most = flag.values(2);
    if most == 0
        if ~(islogical(value) && isscalar(value))
            error('planish:argument', '%s is a switch; give true or false', strrep(flag.name, '-', '_'));
        end
        words = {};
        if value
            words = {name};
        end
    elseif iscell(value)
        if ~flag.repeats
            error('planish:argument', '%s is given once; give no cell array', strrep(flag.name, '-', '_'));
        end
        each = cellfun(@(v) words_of(flag, v), value, 'UniformOutput', false);
        words = [each{:}];
    elseif isnumeric(value) && ~isscalar(value)
        texts = arrayfun(@number, value(:)', 'UniformOutput', false);
        if most > 1
            words = [{name}, texts];
        else
            words = {[name '=' strjoin(texts, ',')]};
        end
    else
        words = {[name '=' word(value)]};
    end
end

function text = word(value)
    if isstruct(value) && isfield(value, 'path')
        text = value.path;
    elseif ischar(value)
        text = value;
    elseif isnumeric(value) && isscalar(value)
        text = number(value);
    else
        error('planish:argument', ...
              'a %s is no value of a flag; give a text, a number or a loaded artifact', class(value));
    end
end

% The shortest decimal number that is this one.
function text = number(value)
    for digits = 15:17
        text = sprintf('%.*g', digits, value);
        if str2double(text) == double(value)
            return
        end
    end
end

% What a program says of itself, command by command.
function command = find_command(title)
    words = strsplit(strtrim(title), ' ');
    persistent described
    if isempty(described)
        described = struct();
    end
    file = ['planish-' words{1}];
    folder = getenv('PLANISH_PROGRAMS');
    if ~isempty(folder)
        file = fullfile(folder, file);
    end
    key = ['of_' regexprep(file, '[^A-Za-z0-9]', '_')];
    if ~isfield(described, key)
        [code, text] = run({file, '--describe'});
        if code ~= 0
            error('planish:program', ['%s cannot be run: %s; give the folder of the programs in ' ...
                  'PLANISH_PROGRAMS, or put it into the PATH'], file, strtrim(text));
        end
        described.(key) = jsondecode(text);
    end
    commands = as_cell(described.(key).commands);
    name = strjoin(words(2:end), ' ');
    at = find(cellfun(@(c) strcmp(c.name, strrep(name, '_', '-')), commands), 1);
    if isempty(at)
        names = cellfun(@(c) c.name, commands, 'UniformOutput', false);
        error('planish:argument', '%s has no command ''%s''; there are %s', words{1}, name, strjoin(names, ', '));
    end
    command = commands{at};
    command.title = strtrim(title);
    command.file = file;
    command.flags = as_cell(command.flags);
end

% jsondecode makes an array of structures where all have the same fields, a cell array otherwise.
function cells = as_cell(list)
    if iscell(list)
        cells = list(:)';
    else
        cells = num2cell(list(:)');
    end
end

function text = help_text(command)
    lines = {command.about, ''};
    for k = 1:numel(command.flags)
        flag = command.flags{k};
        lines{end + 1} = sprintf('    %s: %s', strrep(flag.name, '-', '_'), regexprep(flag.help, '\s+', ' '));
    end
    text = strjoin(lines, sprintf('\n'));
end

% --------------------------------------------------------------------------------------------------------------------
% Artifacts

function artifact = load_artifact(folder)
    if ~exist(folder, 'dir')
        error('planish:program', ...
              '%s: is no directory; give the directory that a program wrote, or planish(''save'', ...)', folder);
    end
    artifact = struct('path', folder, 'manifest', [], 'negative', '');
    files = dir(fullfile(folder, '*.npy'));
    for k = 1:numel(files)
        [~, name] = fileparts(files(k).name);
        artifact.(name) = read_npy(fullfile(folder, files(k).name));
    end
    manifest = fullfile(folder, 'manifest.json');
    if exist(manifest, 'file')
        artifact.manifest = jsondecode(fileread(manifest));
        outcome = artifact.manifest.outcome;
        if isfield(outcome, 'status') && strcmp(outcome.status, 'negative')
            artifact.negative = outcome.reason;
        end
    elseif isempty(files)
        error('planish:program', ...
              '%s: has neither arrays nor a manifest; give the directory of an artifact', folder);
    end
end

function save_arrays(folder, varargin)
    names = varargin(1:2:end);
    if isempty(names) || mod(numel(varargin), 2) == 1
        error('planish:argument', ...
              'save needs names and arrays, such as ''height_nm'', height, ''x_mm'', x, ''y_mm'', y');
    end
    for k = 1:numel(names)
        array = varargin{2 * k};
        if ~(isnumeric(array) || islogical(array)) || ~isreal(array)
            error('planish:argument', '%s: has the type %s; give real numbers', names{k}, class(array));
        end
    end
    if exist(folder, 'dir') || exist(folder, 'file')
        found = dir(folder);
        found = sort(setdiff({found.name}, {'.', '..'}));
        wanted = sort(cellfun(@(name) [name '.npy'], names, 'UniformOutput', false));
        if ~isempty(found) && ~isequal(found(:), wanted(:))
            error('planish:argument', '%s: holds something else; give another directory, or remove it', folder);
        end
    end
    if ~exist(folder, 'dir')
        mkdir(folder);
    end
    for k = 1:numel(names)
        write_npy(fullfile(folder, [names{k} '.npy']), double(varargin{2 * k}));
    end
end

% As numpy.save writes doubles: the first dimension varies slowest, and vectors have one dimension.
function write_npy(file, array)
    shape = size(array);
    if isvector(array)
        shape = numel(array);
        sizes = sprintf('(%d,)', shape);
    else
        sizes = ['(' strjoin(arrayfun(@(n) sprintf('%d', n), shape, 'UniformOutput', false), ', ') ')'];
        array = permute(array, ndims(array):-1:1);
    end
    header = ['{''descr'': ''<f8'', ''fortran_order'': False, ''shape'': ' sizes ', }'];
    % Room for a longer first dimension, and up to a multiple of 64 bytes.
    header = [header, repmat(' ', 1, 21 - numel(sprintf('%d', shape(1))))];
    header = [header, repmat(' ', 1, 64 - mod(10 + numel(header) + 1, 64)), sprintf('\n')];
    temporary = [file '.new'];
    [id, message] = fopen(temporary, 'w', 'ieee-le');
    if id < 0
        error('planish:program', '%s: cannot be written: %s', file, message);
    end
    fwrite(id, [147, double('NUMPY'), 1, 0], 'uint8');
    fwrite(id, numel(header), 'uint16');
    fwrite(id, double(header), 'uint8');
    fwrite(id, array(:), 'double');
    fclose(id);
    movefile(temporary, file);
end

function array = read_npy(file)
    [id, message] = fopen(file, 'r', 'ieee-le');
    if id < 0
        error('planish:program', '%s: cannot be read: %s', file, message);
    end
    closes = onCleanup(@() fclose(id));
    magic = fread(id, 8, 'uint8')';
    if numel(magic) < 8 || ~isequal(magic(1:6), [147, double('NUMPY')])
        error('planish:program', '%s: is no .npy file', file);
    end
    if magic(7) == 1
        count = fread(id, 1, 'uint16');
    else
        count = fread(id, 1, 'uint32');
    end
    header = char(fread(id, count, 'uint8')');
    descr = regexp(header, '''descr'': ''([^'']*)''', 'tokens', 'once');
    types = struct('f8', 'double', 'f4', 'single', 'i8', 'int64', 'i4', 'int32', 'i2', 'int16', 'i1', 'int8', ...
                   'u8', 'uint64', 'u4', 'uint32', 'u2', 'uint16', 'u1', 'uint8', 'b1', 'uint8');
    if isempty(descr) || ~any(descr{1}(1) == '<|') || ~isfield(types, descr{1}(2:end))
        error('planish:program', '%s: has a type that is not read here; convert it with numpy', file);
    end
    type = types.(descr{1}(2:end));
    shape = regexp(header, '''shape'': \(([^)]*)\)', 'tokens', 'once');
    shape = sscanf(strrep(shape{1}, ',', ' '), '%d')';
    array = fread(id, inf, ['*' type]);
    if strcmp(descr{1}(2:end), 'b1')
        array = logical(array);
    end
    if numel(array) ~= prod(shape)
        error('planish:program', '%s: holds %d numbers where its header says %d', file, numel(array), prod(shape));
    end
    if numel(shape) > 1 && ~isempty(strfind(header, '''fortran_order'': True'))
        array = reshape(array, shape);
    elseif numel(shape) > 1
        array = permute(reshape(array, fliplr(shape)), numel(shape):-1:1);
    end
end
