import canopen
import pytest


@pytest.mark.hdbridge_drive(profile="article", bus="virtual")
def test_the_drive_tells_its_name_and_its_state(hdbridge_drive):
    network = canopen.Network()
    network.connect(interface=hdbridge_drive.interface, channel=hdbridge_drive.channel)
    node = network.add_node(hdbridge_drive.node_id, str(hdbridge_drive.eds_path))
    assert node.sdo[0x1018][1].raw == 0x4844
    node.sdo[0x6040].raw = 0x06
    assert hdbridge_drive.state == "ready to switch on"
    hdbridge_drive.fault("drive_fault", code=0x4310)
    hdbridge_drive.wait_until(lambda: node.emcy.active)
    assert node.emcy.active[-1].code == 0x4310
    network.disconnect()
