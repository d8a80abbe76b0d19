// Draws a dashboard's JSON with Grafana's own components: fields, units, thresholds, mappings and overrides by @grafana/data; panels'
// frames, time series, legends, single values and tables by @grafana/ui. Grafana's panel plugins aren't published: what they do between
// the two (their defaults, which option goes where) is repeated here for the types that our dashboards use, and a state timeline is
// drawn by this file alone.
import '@fontsource/inter/400.css';
import '@fontsource/inter/500.css';
import {
  applyFieldOverrides,
  createTheme,
  dateTime,
  FieldType,
  getFieldDisplayName,
  getFieldDisplayValues,
  getDisplayValueAlignmentFactors,
  identityOverrideProcessor,
  Registry,
  standardTransformers,
  standardTransformersRegistry,
  ThemeContext,
  thresholdsOverrideProcessor,
  transformDataFrame,
  unitOverrideProcessor,
  valueMappingsOverrideProcessor,
} from '@grafana/data';
import { BigValue, GlobalStyles, PanelChrome, Table, TimeSeries, VizLegend, VizRepeater } from '@grafana/ui';
import * as React from 'react';
import { createRoot } from 'react-dom/client';

const given = window.given;
const theme = createTheme({ colors: { mode: given.theme } });
const [ROW, COLUMNS, MARGIN, HEAD] = [30, 24, 8, 64];

// -- fields: which options there are, and what they are where a panel doesn't say ---------------------------------------------------

const PROCESSORS = {
  unit: unitOverrideProcessor,
  thresholds: thresholdsOverrideProcessor,
  mappings: valueMappingsOverrideProcessor,
};
const STANDARD = ['unit', 'min', 'max', 'decimals', 'displayName', 'color', 'noValue', 'thresholds', 'mappings', 'links'];
const THRESHOLDS = { mode: 'absolute', steps: [{ value: -Infinity, color: 'green' }, { value: 80, color: 'red' }] };
const CUSTOM = {
  timeseries: {
    drawStyle: 'line', lineInterpolation: 'linear', lineWidth: 1, fillOpacity: 0, gradientMode: 'none', spanNulls: false,
    insertNulls: false, showPoints: 'auto', pointSize: 5, stacking: { mode: 'none', group: 'A' }, axisPlacement: 'auto',
    axisLabel: '', axisColorMode: 'text', axisBorderShow: false, axisCenteredZero: false, scaleDistribution: { type: 'linear' },
    thresholdsStyle: { mode: 'off' }, hideFrom: { legend: false, tooltip: false, viz: false }, barAlignment: 0, barWidthFactor: 0.6,
    lineStyle: { fill: 'solid' }, axisSoftMin: undefined, axisSoftMax: undefined,
  },
  table: { align: 'auto', cellOptions: { type: 'auto' }, inspect: false, filterable: false, minWidth: 150, width: undefined },
  'state-timeline': { fillOpacity: 70, lineWidth: 0 },
  stat: {},
};

function registry(type) {
  const item = (id, isCustom) => ({
    id: isCustom ? `custom.${id}` : id,
    path: id,
    name: id,
    isCustom,
    process: PROCESSORS[id] ?? identityOverrideProcessor,
    shouldApply: () => true,
    settings: {},
  });
  return new Registry(() => [...STANDARD.map((id) => item(id, false)), ...Object.keys(CUSTOM[type]).map((id) => item(id, true))]);
}

function configured(panel) {
  const { defaults, overrides } = panel.fieldConfig;
  const steps = (thresholds) => ({
    ...thresholds,
    steps: thresholds.steps.map((step) => ({ ...step, value: step.value ?? -Infinity })),
  });
  const color = { mode: panel.type === 'timeseries' ? 'palette-classic' : 'thresholds' };
  return {
    defaults: {
      color,
      mappings: [],
      ...defaults,
      thresholds: steps(defaults.thresholds ?? THRESHOLDS),
      custom: { ...CUSTOM[panel.type], ...defaults.custom },
    },
    overrides,
  };
}

// -- what Prometheus answered, as frames ---------------------------------------------------------------------------------------------

function legend(target, metric) {
  if (target.legendFormat) {
    return target.legendFormat.replace(/\{\{\s*(\w+)\s*\}\}/g, (_, label) => metric[label] ?? '');
  }
  const labels = Object.entries(metric).filter(([name]) => name !== '__name__');
  return labels.length ? `${metric.__name__ ?? ''}{${labels.map(([k, v]) => `${k}="${v}"`).join(', ')}}` : target.expr;
}

function series({ target, result }) {
  return result.map(({ metric, values, value }) => {
    const told = values ?? [value];
    const { __name__, ...labels } = metric;
    return {
      refId: target.refId,
      length: told.length,
      fields: [
        {
          name: 'Time',
          type: FieldType.time,
          config: { interval: given.step * 1000 },
          values: told.map(([time]) => time * 1000),
        },
        {
          name: 'Value',
          type: FieldType.number,
          labels,
          config: { displayNameFromDS: legend(target, metric) },
          values: told.map(([, text]) => (text === 'NaN' ? NaN : Number(text.replace('Inf', 'Infinity')))),
        },
      ],
    };
  });
}

function table({ target, result }, several) {
  const labels = [...new Set(result.flatMap(({ metric }) => Object.keys(metric)))].sort();
  const column = (name, type, values) => ({ name, type, config: {}, values });
  return {
    refId: target.refId,
    length: result.length,
    fields: [
      column('Time', FieldType.time, result.map(({ value }) => value[0] * 1000)),
      ...labels.map((label) => column(label, FieldType.string, result.map(({ metric }) => metric[label] ?? ''))),
      column(several ? `Value #${target.refId}` : 'Value', FieldType.number, result.map(({ value }) => Number(value[1]))),
    ],
  };
}

const replaceVariables = (text) => text;
const transformations = new Map(Object.values(standardTransformers).map((each) => [each.id, each]));
standardTransformersRegistry.setInit(() => [...transformations.values()].map((each) => ({ id: each.id, name: each.name, transformation: each })));

async function frames(panel) {
  const answers = given.panels[panel.id];
  let found = answers.flatMap((answer) => (answer.target.format === 'table' ? [table(answer, answers.length > 1)] : series(answer)));
  if (panel.transformations) {
    found = await new Promise((done) => transformDataFrame(panel.transformations, found).subscribe(done));
  }
  return applyFieldOverrides({
    data: found,
    fieldConfig: configured(panel),
    fieldConfigRegistry: registry(panel.type),
    replaceVariables,
    theme,
    timeZone: 'utc',
  });
}

// -- panels --------------------------------------------------------------------------------------------------------------------------

const timeRange = { from: dateTime(given.from * 1000), to: dateTime(given.to * 1000), raw: { from: 'now-1h', to: 'now' } };

function Nothing({ panel }) {
  const style = { display: 'grid', placeItems: 'center', height: '100%', color: theme.colors.text.secondary };
  return <div style={style}>{panel.fieldConfig.defaults.noValue ?? 'No data'}</div>;
}

function TimeSeriesPanel({ panel, data, width, height }) {
  const options = { showLegend: true, displayMode: 'list', placement: 'bottom', calcs: [], ...panel.options.legend };
  return (
    <TimeSeries frames={data} structureRev={1} timeRange={timeRange} timeZone="utc" width={width} height={height} legend={options} options={panel.options} />
  );
}

function StatPanel({ panel, data, width, height }) {
  const { reduceOptions, colorMode = 'value', graphMode = 'area', textMode = 'auto', justifyMode = 'auto' } = panel.options;
  const values = getFieldDisplayValues({
    fieldConfig: configured(panel), reduceOptions, replaceVariables, theme, data, sparkline: graphMode !== 'none', timeZone: 'utc',
  });
  return (
    <VizRepeater
      source={values}
      getValues={() => values}
      getAlignmentFactors={getDisplayValueAlignmentFactors}
      itemSpacing={3}
      width={width}
      height={height}
      orientation={panel.options.orientation ?? 'auto'}
      renderValue={({ value, alignmentFactors, width, height, count }) => (
        <BigValue
          value={value.display}
          count={count}
          sparkline={value.sparkline}
          colorMode={colorMode}
          graphMode={graphMode}
          justifyMode={justifyMode}
          textMode={textMode === 'auto' && values.length === 1 ? 'value' : textMode}
          alignmentFactors={alignmentFactors}
          width={width}
          height={height}
          theme={theme}
        />
      )}
    />
  );
}

function StateTimelinePanel({ panel, data, width, height }) {
  const [names, axis, below] = [110, 24, panel.options.legend?.showLegend === false ? 0 : 28];
  const rows = data.map((frame) => {
    const [times, field] = frame.fields;
    const runs = [];
    times.values.forEach((time, place) => {
      const value = field.values[place];
      const last = runs[runs.length - 1];
      const end = time + given.step * 1000;
      if (last && last.value === value && last.end >= time) {
        last.end = end;
      } else {
        runs.push({ value, begin: time, end });
      }
    });
    return { name: getFieldDisplayName(field, frame, data), runs, field };
  });
  const [begin, end] = [given.from * 1000, given.to * 1000];
  const x = (time) => names + ((Math.min(time, end) - begin) / (end - begin)) * (width - names - 8);
  const each = (height - axis - below) / Math.max(1, rows.length);
  const thick = each * (panel.options.rowHeight ?? 0.9);
  const ticks = [...Array(13).keys()].map((step) => begin + ((end - begin) * step) / 12);
  const shown = new Map();
  rows.forEach(({ field, runs }) => runs.forEach(({ value }) => shown.set(field.display(value).text, field.display(value).color)));
  return (
    <>
      <svg width={width} height={height - below} style={{ display: 'block', font: `12px ${theme.typography.fontFamily}` }}>
        {ticks.map((tick) => (
          <g key={tick}>
            <line x1={x(tick)} x2={x(tick)} y1={0} y2={height - below - axis} stroke={theme.colors.border.weak} />
            <text x={x(tick)} y={height - below - 6} textAnchor="middle" fill={theme.colors.text.primary}>
              {new Date(tick).toISOString().slice(11, 16)}
            </text>
          </g>
        ))}
        {rows.map(({ name, runs, field }, row) => (
          <g key={name}>
            <text x={names - 8} y={each * (row + 0.5) + 4} textAnchor="end" fill={theme.colors.text.primary}>
              {name}
            </text>
            {runs.map(({ value, begin, end }) => {
              const { color, text } = field.display(value);
              const wide = x(end) - x(begin);
              return (
                <g key={begin}>
                  <rect x={x(begin)} width={wide} y={each * row + (each - thick) / 2} height={thick} fill={color} fillOpacity={0.7} />
                  {panel.options.showValue !== 'never' && wide > 8 * text.length && (
                    <text x={x(begin) + 6} y={each * (row + 0.5) + 4} fill={theme.colors.getContrastText(color)}>
                      {text}
                    </text>
                  )}
                </g>
              );
            })}
          </g>
        ))}
      </svg>
      {below > 0 && (
        <VizLegend placement="bottom" displayMode="list" items={[...shown].map(([label, color]) => ({ label, color, yAxis: 1 }))} />
      )}
    </>
  );
}

function TablePanel({ panel, data, width, height }) {
  return <Table data={data[0]} width={width} height={height} initialSortBy={panel.options.sortBy} />;
}

const PANELS = { timeseries: TimeSeriesPanel, stat: StatPanel, 'state-timeline': StateTimelinePanel, table: TablePanel };

function Panel({ panel, data }) {
  const cell = (given.width - 2 * MARGIN - (COLUMNS - 1) * MARGIN) / COLUMNS;
  const { x, y, w, h } = panel.gridPos;
  const [width, height] = [w * cell + (w - 1) * MARGIN, h * ROW + (h - 1) * MARGIN];
  const Drawn = panel.type === 'stat' || data.some((frame) => frame.length) ? PANELS[panel.type] : Nothing;
  return (
    <div style={{ position: 'absolute', left: MARGIN + x * (cell + MARGIN), top: HEAD + y * (ROW + MARGIN), width, height }}>
      <PanelChrome title={panel.title} description={panel.description ?? ''} width={width} height={height}>
        {(width, height) => <Drawn {...{ panel, data, width, height }} />}
      </PanelChrome>
    </div>
  );
}

function Head() {
  const pill = { border: `1px solid ${theme.colors.border.medium}`, borderRadius: 2, padding: '5px 10px', background: theme.colors.background.primary };
  const [from, to] = [given.from, given.to].map((time) => new Date(time * 1000).toISOString().slice(11, 16));
  return (
    <div style={{ position: 'absolute', left: MARGIN, right: MARGIN, top: 14, display: 'flex', gap: 16, alignItems: 'center' }}>
      <span style={{ fontSize: 18, fontWeight: 500, marginRight: 'auto' }}>{given.board.title}</span>
      {Object.entries(given.variables).map(([name, value]) => (
        <span key={name}>
          {name}&ensp;<span style={pill}>{value}</span>
        </span>
      ))}
      <span style={pill}>
        {from} to {to} UTC
      </span>
    </div>
  );
}

async function draw() {
  const panels = given.board.panels;
  const data = await Promise.all(panels.map(frames));
  document.body.style.background = theme.colors.background.canvas;
  const root = document.body.appendChild(document.createElement('div'));
  createRoot(root).render(
    <ThemeContext.Provider value={theme}>
      <GlobalStyles />
      <Head />
      {panels.map((panel, place) => (
        <Panel key={panel.id} panel={panel} data={data[place]} />
      ))}
    </ThemeContext.Provider>
  );
}

// Widths of texts are taken when things are drawn.
Promise.all(['400 12px Inter', '500 14px Inter'].map((font) => document.fonts.load(font))).then(draw);
