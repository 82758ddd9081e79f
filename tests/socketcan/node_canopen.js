// A master built on the npm package `canopen`: mode 1 by SDO, mode 8 by PDOs, LSS. Arguments: interface, EDS.
const { Device, DataType, Eds } = require('canopen');
const NODE = 5, DEGREE = 36000;
const { UNSIGNED8: U8, UNSIGNED16: U16, UNSIGNED32: U32, INTEGER8: I8, INTEGER32: I32 } = DataType;
const [name, eds] = process.argv.slice(2);
const channel = require('socketcan').createRawChannel(name);
const device = new Device({ id: 126, enableLss: true });
device.addListener('message', (frame) => channel.send(frame));
channel.addListener('onMessage', (frame) => device.receive(frame));
channel.start();
const wait = (ms) => new Promise((done) => setTimeout(done, ms));
const read = (index, dataType, subIndex = 0) => device.sdo.upload({ serverId: NODE, index, subIndex, dataType });
const write = (index, dataType, data, subIndex = 0) =>
    device.sdo.download({ serverId: NODE, index, subIndex, dataType, data });

async function until(mask, value, statusword = () => read(0x6041, U16)) {
    let word;
    for (let k = 0; k < 500; k++, await wait(20)) if (((word = await statusword()) & mask) === value) return;
    throw new Error(`statusword ${word.toString(16)}, expected ${value.toString(16)}`);
}

async function map(first, cobId, words) {
    await write(first, U32, (0x80000000 | cobId) >>> 0, 1);
    await write(first + 0x200, U8, 0);
    for (const [place, word] of words.entries()) await write(first + 0x200, U32, word, place + 1);
    await write(first + 0x200, U8, words.length);
    await write(first, U8, 1, 2);
    await write(first, U32, cobId, 1);
}

async function main() {
    const own = (index, dataType) => device.eds.addEntry(index, { parameterName: `own ${index}`, dataType });
    const [word, target, status, actual] = [own(0x2000, U16), own(0x2001, I32), own(0x2002, U16), own(0x2003, I32)];
    device.eds.addSdoClientParameter(NODE, 0x600 + NODE, 0x580 + NODE);
    device.eds.setSyncCobId(0x80);
    device.eds.setSyncCyclePeriod(20000);
    device.eds.setSyncGenerationEnable(true);
    // Its synchronous TPDOs wait for the SYNC of another node, so they are sent on a change of value.
    device.eds.addTransmitPdo({ cobId: 0x205, transmissionType: 254, dataObjects: [word, target] });
    device.eds.addReceivePdo({ cobId: 0x185, transmissionType: 255, dataObjects: [status, actual] });
    device.start();
    device.nmt.enterPreOperational(NODE);
    const found = { objects: [...Eds.fromFile(eds).keys()].length, name: await read(0x1008, DataType.VISIBLE_STRING) };

    await write(0x6060, I8, 1);
    for (const [command, mask, state] of [[0x80, 0x4f, 0x40], [6, 0x6f, 0x21], [7, 0x6f, 0x23], [15, 0x6f, 0x27]]) {
        await write(0x6040, U16, command);
        await until(mask, state);
    }
    let start = await read(0x6064, I32);
    await write(0x607a, I32, start + 2 * DEGREE);
    await write(0x6040, U16, 0x1f);
    await until(0x1000, 0x1000);
    await write(0x6040, U16, 0x0f);
    await until(0x400, 0x400);
    await wait(1000);
    found.profile_deg = ((await read(0x6064, I32)) - start) / DEGREE;
    await write(0x6040, U16, 0);
    await until(0x4f, 0x40);

    await map(0x1400, 0x205, [0x60400010, 0x607a0020]);
    await map(0x1800, 0x185, [0x60410010, 0x60640020]);
    await write(0x6060, I8, 8);
    start = await read(0x6064, I32);
    device.nmt.startNode(NODE);
    device.nmt.startNode();
    for (const [command, state] of [[6, 0x21], [7, 0x23], [15, 0x27]]) {
        device.setValue(0x2001, start);
        device.setValue(0x2000, command);
        await until(0x6f, state, () => device.getValue(0x2002));
    }
    for (let k = 1; k <= 100; k++, await wait(20)) device.setValue(0x2001, start + k * 0.03 * DEGREE);
    await wait(1000);
    found.cyclic_deg = (device.getValue(0x2003) - start) / DEGREE;
    device.setValue(0x2000, 0);
    await until(0x4f, 0x40, () => device.getValue(0x2002));
    found.unconfigured = await device.lss.fastscan();
    console.log(JSON.stringify(found));
}

main().then(() => process.exit(0), (error) => { console.error(error.message); process.exit(1); });
